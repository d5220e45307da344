# SPDX-License-Identifier: Apache-2.0
"""Sums of bytes side by side, as kernels add them up: 64 at a time."""

from __future__ import annotations

from typing import Any

from rlml_slam.compiled import intrinsic


def _sum_lanes(
    _typing: Any, array: Any, offsets: Any, _count: Any, _shift: Any, _least: Any, sums: Any
) -> Any:
    """Typing and code of sum_lanes: 64 bytes are added at once, 17 times at most."""
    from llvmlite import ir
    from numba import types

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        data, at, out = (
            context.make_array(signature.args[k])(context, b, args[k]).data for k in (0, 1, 5)
        )
        count, shift, least = args[2], args[3], args[4]
        index, short = ir.IntType(64), ir.IntType(16)
        narrow, wide = ir.VectorType(ir.IntType(8), 64), ir.VectorType(short, 64)
        before = b.block
        outer, inner, after, end = (b.append_basic_block() for _ in range(4))
        b.branch(outer)
        b.position_at_end(outer)
        first, total = b.phi(index), b.phi(wide)
        group = b.add(first, index(17))
        stop = b.select(b.icmp_signed('<', group, count), group, count)
        b.cbranch(b.icmp_signed('<', first, count), inner, end)
        b.position_at_end(inner)
        k, some = b.phi(index), b.phi(narrow)
        place = b.gep(data, [b.add(b.load(b.gep(at, [k])), shift)])
        more = b.add(some, b.load(b.bitcast(place, narrow.as_pointer()), align=1))
        following = b.add(k, index(1))
        b.cbranch(b.icmp_signed('<', following, stop), inner, after)
        b.position_at_end(after)
        larger = b.add(total, b.zext(more, wide))
        b.branch(outer)
        for phi, start, value, source in (
            (first, index(0), stop, after), (total, ir.Constant(wide, None), larger, after),
        ):  # fmt: skip
            phi.add_incoming(start, before)
            phi.add_incoming(value, source)
        for phi, start, value in (
            (k, first, following), (some, ir.Constant(narrow, None), more),
        ):  # fmt: skip
            phi.add_incoming(start, outer)
            phi.add_incoming(value, inner)
        b.position_at_end(end)
        b.store(total, b.bitcast(out, wide.as_pointer()), align=1)
        lane = b.insert_element(ir.Constant(wide, None), b.trunc(least, short), ir.IntType(32)(0))
        limit = b.shuffle_vector(lane, lane, ir.Constant(ir.VectorType(ir.IntType(32), 64), None))
        return b.bitcast(b.icmp_unsigned('>=', total, limit), index)

    number = types.int64
    return types.uint64(array, offsets, number, number, number, sums), generate


# sum_lanes(bytes, offsets, count, shift, least, sums): for each of 64 neighbours the sum of
# bytes[offsets[k] + shift], k < count, into ``sums`` (64,) uint16; bytes are at most 15. Returns
# a word with a bit for each sum that is ``least`` or more; for kernels only, and not checked
sum_lanes: Any = intrinsic(_sum_lanes)
