# SPDX-License-Identifier: Apache-2.0
"""Sums of half bytes side by side, as kernels add them up: 64 of a row and of the row below."""

from __future__ import annotations

from typing import Any

from rlml_slam.compiled import intrinsic


def _sum_lanes(
    _typing: Any, array: Any, offsets: Any, span: Any, _shift: Any, _least: Any, sums: Any,
    _to: Any,
) -> Any:  # fmt: skip
    """Typing and code of sum_lanes: 64 bytes are added at once, 17 times at most."""
    from llvmlite import ir
    from numba import types

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        data, at, out = (
            context.make_array(signature.args[k])(context, b, args[k]).data for k in (0, 1, 5)
        )
        begin, end = (b.extract_value(args[2], k) for k in (0, 1))
        shift, least = args[3:5]
        index, short, byte = ir.IntType(64), ir.IntType(16), ir.IntType(8)
        narrow, wide = ir.VectorType(byte, 64), ir.VectorType(short, 64)
        four, mask = (ir.Constant(narrow, [value] * 64) for value in (4, 15))
        before = b.block
        outer, inner, after, done = (b.append_basic_block() for _ in range(4))
        b.branch(outer)
        b.position_at_end(outer)
        first, totals = b.phi(index), [b.phi(wide) for _ in range(2)]
        group = b.add(first, index(17))
        stop = b.select(b.icmp_signed('<', group, end), group, end)
        b.cbranch(b.icmp_signed('<', first, end), inner, done)
        b.position_at_end(inner)
        k, some = b.phi(index), [b.phi(narrow) for _ in range(2)]
        place = b.gep(data, [b.add(b.load(b.gep(at, [k])), shift)])
        both = b.load(b.bitcast(place, narrow.as_pointer()), align=1)
        more = [b.add(some[0], b.and_(both, mask)), b.add(some[1], b.lshr(both, four))]
        following = b.add(k, index(1))
        b.cbranch(b.icmp_signed('<', following, stop), inner, after)
        b.position_at_end(after)
        larger = [b.add(total, b.zext(v, wide)) for total, v in zip(totals, more, strict=True)]
        b.branch(outer)
        for phis, starts, values, sources in (
            ((first, *totals), (begin, *[wide(None)] * 2), (stop, *larger), (before, after)),
            ((k, *some), (first, *[narrow(None)] * 2), (following, *more), (outer, inner)),
        ):
            for phi, start, value in zip(phis, starts, values, strict=True):
                phi.add_incoming(start, sources[0])
                phi.add_incoming(value, sources[1])
        b.position_at_end(done)
        lane = b.insert_element(ir.Constant(wide, None), b.trunc(least, short), ir.IntType(32)(0))
        limit = b.shuffle_vector(lane, lane, ir.Constant(ir.VectorType(ir.IntType(32), 64), None))
        hits = []
        for row, total in enumerate(totals):
            place = b.gep(out, [b.add(args[6], index(64 * row))])
            b.store(total, b.bitcast(place, wide.as_pointer()), align=1)
            hits.append(b.bitcast(b.icmp_unsigned('>=', total, limit), index))
        return context.make_tuple(b, signature.return_type, hits)

    number = types.int64
    words = types.UniTuple(types.uint64, 2)  # type: ignore[no-untyped-call]
    return words(array, offsets, span, number, number, sums, number), generate


# sum_lanes(bytes, offsets, (a, b), shift, least, sums, to): for each of 64 neighbours the sums
# of the lower and of the upper four bits of bytes[offsets[k] + shift], a <= k < b, into
# ``sums`` uint16 from ``to`` on, 64 of each. Returns for both a word with a bit for each sum that
# is ``least`` or more; for kernels only, and not checked
sum_lanes: Any = intrinsic(_sum_lanes)
