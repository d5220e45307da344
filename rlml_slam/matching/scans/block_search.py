# SPDX-License-Identifier: Apache-2.0
"""Kernels of branch and bound: all of the largest blocks, then parts of the best ones.

The bound of a block is the sum of the pooled cells that its end points can meet. Functions that
are called often take arrays, not tuples of them: out of a tuple, a reference is counted each time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import formula, kernel, load8, part
from rlml_slam.matching.scans.byte_sums import sum_lanes
from rlml_slam.matching.scans.search_pyramid import BEFORE, FULL, LANES, UNIT, Level, Levels, place

Integers = NDArray[np.int64]

SIDE = 8  # of the largest blocks
SHIFTS, ANGLES = 1 << 14, 1 << 16  # of blocks, as they are packed into one number


class Lattice(NamedTuple):
    """Poses that are searched: ``cells`` (angles, n, 2) of the end points at the first shift.

    (column, row) of the padded grid; shifts go on to ``shifts`` (columns, rows) from there.
    ``allowed`` (block rows, block columns) says in which blocks of shifts there are poses.
    """

    cells: NDArray[np.int32]
    shifts: tuple[int, int]
    allowed: NDArray[np.uint8]


class Goal(NamedTuple):
    """Criteria in sums of cells; the second needs more than ``offset`` + ``share`` * the best.

    Poses from ``weak`` to ``threshold`` are looked for within ``weak_budget``, without a second.
    """

    threshold: int
    offset: float
    share: float
    separation: float
    turns: float
    circular: bool
    budget: int
    weak: int
    weak_budget: int


class Table(NamedTuple):
    """Where the bounds of end points are: ``offsets`` (groups * n) in the data of a level.

    ``first`` (groups, n + 3, 2) are cells (column, row) at the first shift, the least and the
    largest of them, and their number: other points move too far within the angles of a group, and
    count as hits. ``offsets`` has room for n more.
    """

    offsets: Integers
    first: NDArray[np.int32]


@part
def tabulate(level: Level, cells: NDArray[np.int32], span: int) -> Table:
    """The table of a level for groups of ``span`` angles."""
    m, n = cells.shape[0], cells.shape[1]
    groups = (m + span - 1) // span
    offsets, first = np.empty((groups + 1) * n, np.int64), np.empty((groups, n + 3, 2), np.int32)
    for g in range(groups):
        count = 0
        first[g, n], first[g, n + 1] = 1 << 30, -(1 << 30)
        least, most = first[g, n], first[g, n + 1]
        for k in range(n):
            j0, i0 = cells[g * span, k, 0], cells[g * span, k, 1]
            j1, i1 = j0, i0
            for a in range(g * span + 1, min((g + 1) * span, m)):
                j, i = cells[a, k, 0], cells[a, k, 1]
                j0, j1, i0, i1 = min(j0, j), max(j1, j), min(i0, i), max(i1, i)
            at = place(level, i0, j0, max(i1 - i0, j1 - j0))
            if at < 0:
                continue
            offsets[g * n + count] = at
            first[g, count, 0], first[g, count, 1] = j0, i0
            least[0], least[1] = min(least[0], j0), min(least[1], i0)
            most[0], most[1] = max(most[0], j0), max(most[1], i0)
            count += 1
        first[g, n + 2] = count
    return Table(offsets, first)


@formula
def reachable(
    offsets: Integers, first: NDArray[np.int32], end: tuple[int, int], g: int,
    shift: tuple[int, int], lanes: int,
) -> tuple[int, int]:  # fmt: skip
    """Which offsets of group ``g`` are of end points that may meet a cell of the grid at a shift.

    ``shift`` (columns, rows), ``end`` that of the grid; ``lanes`` are the blocks to the right that
    are looked up too. Returns the first one, and that after the last one.
    """
    n, left = first.shape[1] - 3, -SIDE * (lanes - 1)
    count, begin = int(first[g, n + 2, 0]), g * n
    if (
        first[g, n, 0] + shift[0] >= left
        and first[g, n, 1] + shift[1] >= 0
        and first[g, n + 1, 0] + shift[0] < end[0]
        and first[g, n + 1, 1] + shift[1] < end[1]
    ):
        return begin, begin + count
    room = last = len(offsets) - n
    for k in range(count):
        j, i = first[g, k, 0] + shift[0], first[g, k, 1] + shift[1]
        if left <= j < end[0] and 0 <= i < end[1]:
            offsets[last] = offsets[begin + k]
            last += 1
    return room, last


@part
def bounds(
    data: NDArray[np.uint8], columns: int, offsets: Integers, first: NDArray[np.int32],
    end: tuple[int, int], block: tuple[int, int, int], least: int, sums: NDArray[np.uint16],
) -> tuple[int, int, int, int]:  # fmt: skip
    """Into ``sums`` those of LANES blocks from (group, column, row) on, and of those below.

    Returns for both a word with a bit for each sum that is ``least`` or more; and the look-ups.
    """
    g, j, i = block
    to, at, low = np.int64(2 * j), np.int64(i * columns + j), np.int64(least)
    a, b = reachable(offsets, first, end, g, (SIDE * j, SIDE * i), LANES)
    hits, below = sum_lanes(data, offsets, (np.int64(a), np.int64(b)), at, low, sums, to)
    c, d = reachable(offsets, first, end, g, (SIDE * j, SIDE * i + SIDE), LANES)
    if not a == c < len(first) * (first.shape[1] - 3):  # else the same ones meet both rows
        at, to = np.int64(at + columns), np.int64(to + LANES)
        below, _ = sum_lanes(data, offsets, (np.int64(c), np.int64(d)), at, low, sums, to)
    return hits, below, b - a, d - c


@part
def sweep(levels: Levels, lattice: Lattice, table: Table, goal: Goal) -> tuple[Integers, int]:
    """Largest blocks that may hold a pose, a weak one too, best first; the look-ups made.

    A block is (bound, group of angles, row, column) as one number, see packed().
    """
    some, n = allowed_lanes(lattice.allowed), lattice.cells.shape[1]
    data, width = levels.eight.data, levels.eight.columns
    end = levels.width + BEFORE, levels.rows + BEFORE
    (rows, parts), offsets, first = some.shape, table.offsets, table.first
    blocks, count, lookups = np.empty(1024, np.int64), 0, 0
    sums = np.empty(LANES * (2 * parts + 1), np.uint16)
    hits, met = np.zeros((2, parts), np.uint64), np.zeros((2, parts), np.int64)
    for g in range(len(first)):
        sure = FULL * (n - int(first[g, n + 2, 0]))
        least = max(goal.weak // UNIT + 1 - sure, 0)
        for i in range(0, rows, 2):
            if lookups > goal.budget:
                break
            for p in range(parts):
                if some[i, p] or some[i + 1, p]:
                    hits[0, p], hits[1, p], met[0, p], met[1, p] = bounds(
                        data, width, offsets, first, end, (g, LANES * p, i), least, sums
                    )
            if count + 2 * LANES * parts > len(blocks):
                blocks = np.append(blocks, np.empty(len(blocks) + 2 * LANES * parts, np.int64))
            for row in range(2):
                for p in range(parts):
                    if not some[i + row, p] or lookups > goal.budget:
                        continue
                    lookups += met[row, p]
                    hit = hits[row, p] & some[i + row, p]
                    for q in range(LANES if hit else 0):
                        if (hit >> np.uint64(q)) & np.uint64(1):
                            bound = sums[LANES * (2 * p + row) + q] + sure
                            blocks[count] = packed(bound, g, i + row, LANES * p + q)
                            count += 1
    return ranked(blocks[:count], FULL * n), lookups


@part
def allowed_lanes(allowed: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Which of LANES neighbours are allowed, as bits; (rows, parts), an even number of rows."""
    rows, columns = allowed.shape
    out = np.zeros((rows + rows % 2, (columns + LANES - 1) // LANES), np.uint64)
    for i in range(rows):
        for j in range(columns):
            out[i, j // LANES] |= np.uint64(allowed[i, j]) << np.uint64(j % LANES)
    return out


@part
def packed(bound: int, g: int, i: int, j: int) -> int:
    """A block as one number."""
    return int(((np.int64(bound) * ANGLES + g) * SHIFTS + i) * SHIFTS + j)


@part
def ranked(blocks: Integers, most: int) -> Integers:
    """Blocks by their bounds, which are at most ``most``, the largest first; else in order."""
    unit = ANGLES * SHIFTS * SHIFTS
    ends = np.zeros(most + 2, np.int64)
    for block in blocks:
        ends[most - block // unit + 1] += 1
    ends = np.cumsum(ends)
    out = np.empty_like(blocks)
    for block in blocks:
        rank = most - block // unit
        out[ends[rank]] = block
        ends[rank] += 1
    return out


@kernel
def search(levels: Levels, lattice: Lattice, goal: Goal, found: Integers) -> int:
    """Rows of ``found``: (sum, angle index, column shift, row shift) of best and second, -1 none.

    Returns the look-ups, more than the budget where that did not suffice.
    """
    blocks, lookups = sweep(levels, lattice, tabulate(levels.eight, lattice.cells, 4), goal)
    tables = tabulate(levels.four, lattice.cells, 2), tabulate(levels.two, lattice.cells, 1)
    for rank in range(2):
        best = goal.weak
        if rank == 1:
            best = max(goal.threshold, int(np.floor(goal.offset + goal.share * found[0, 0])))
        for block in blocks:
            rest, j = divmod(block, SHIFTS)
            rest, i = divmod(rest, SHIFTS)
            bound, g = divmod(rest, ANGLES)
            if lookups > goal.weak_budget:
                best = max(best, goal.threshold)
            if UNIT * bound <= best or lookups > goal.budget:
                break
            at = (SIDE * j, SIDE * i)
            if rank == 0 or not is_excluded(goal, len(lattice.cells), found, (4 * g, 4), at, 7):
                lookups += divide(levels, lattice, goal, tables, (g, *at), rank, best, found)
                best = max(best, found[rank, 0])
        if found[0, 0] <= goal.threshold:
            break
    return lookups


@part
def divide(
    levels: Levels, lattice: Lattice, goal: Goal, tables: tuple[Table, Table],
    block: tuple[int, int, int], rank: int, best: int, found: Integers,
) -> int:  # fmt: skip
    """Search a block of side 8, (group, column, row), for a pose above ``best``; the look-ups."""
    end = levels.width + BEFORE, levels.rows + BEFORE
    (g, j, i), (four, two), cells, grid = block, tables, lattice.cells, levels.cells
    data4, shape4 = levels.four.data, (levels.four.side, levels.four.columns)
    data2, shape2 = levels.two.data, (levels.two.side, levels.two.columns)
    offsets4, first4, offsets2, first2 = four.offsets, four.first, two.offsets, two.first
    sums, some, four_poses = np.full(8, -1, np.int64), np.empty(4, np.int64), np.empty(4, np.int64)
    lookups = 0
    for h in range(min(2, len(first4) - 2 * g)):
        at = (2 * g + h, j, i)
        lookups += quarters(data4, shape4, offsets4, first4, end, at, sums, 4 * h)
    while True:
        k = int(np.argmax(sums))
        if UNIT * sums[k] <= best:
            return lookups
        sums[k] = -1
        j4, i4 = j + 4 * (k % 2), i + 4 * (k % 4 // 2)
        for a in range(4 * g + 2 * (k // 4), min(4 * g + 2 * (k // 4) + 2, len(first2))):
            lookups += quarters(data2, shape2, offsets2, first2, end, (a, j4, i4), some, 0)
            for q in range(4):
                if UNIT * some[q] > best:
                    at = (a, j4 + 2 * (q % 2), i4 + 2 * (q // 2))
                    lookups += poses(grid, levels.columns, cells, end, at, four_poses)
                    best = finish(
                        goal, lattice.shifts, len(cells), four_poses, at, rank, best, found
                    )


@part
def finish(
    goal: Goal, most: tuple[int, int], num_angles: int, sums: Integers,
    block: tuple[int, int, int], rank: int, best: int, found: Integers,
) -> int:  # fmt: skip
    """Take the best of 2 x 2 poses from (angle, column, row) on if it is above ``best``."""
    a, j, i = block
    for c in range(4):
        q, r = j + c % 2, i + c // 2
        if sums[c] <= best or q > most[0] or r > most[1]:
            continue
        if rank == 0 or not is_excluded(goal, num_angles, found, (a, 1), (q, r), 0):
            best = sums[c]
            found[rank, 0], found[rank, 1] = best, a
            found[rank, 2], found[rank, 3] = q, r
    return best


@part
def quarters(
    data: NDArray[np.uint8], shape: tuple[int, int], offsets: Integers, first: NDArray[np.int32],
    end: tuple[int, int], block: tuple[int, int, int], sums: Integers, to: int,
) -> int:  # fmt: skip
    """Into ``sums`` from ``to`` on, the bounds of the quarters of a block; the look-ups."""
    (g, j, i), (side, columns), n = block, shape, first.shape[1] - 3
    a, b = reachable(offsets, first, end, g, (j, i), 1)
    shift = i // side * columns + j // side
    for q in range(4):
        sums[to + q] = FULL * (n - int(first[g, n + 2, 0]))
    for begin in range(a, b, UNIT):
        total = np.uint32(0)
        for k in range(begin, min(begin + UNIT, b)):
            # two values of this row and, in the upper bits, two of the row below
            word = np.uint32(load8(data, offsets[k] + shift))
            total += (word & np.uint32(0x0F0F)) | ((word & np.uint32(0xF0F0)) << np.uint32(12))
        for q in range(4):
            sums[to + q] += (total >> np.uint32(8 * q)) & np.uint32(0xFF)
    return int(b - a)


@part
def poses(
    grid: NDArray[np.uint8], columns: int, cells: NDArray[np.int32], end: tuple[int, int],
    block: tuple[int, int, int], sums: Integers,
) -> int:  # fmt: skip
    """Sums (4,) of 2 x 2 poses from (angle, column, row) on, row by row; the look-ups."""
    a, j, i = block
    s0 = s1 = s2 = s3 = 0
    for k in range(cells.shape[1]):
        q, r = cells[a, k, 0] + j, cells[a, k, 1] + i
        if 0 <= q < end[0] and 0 <= r < end[1]:
            upper = np.int64(load8(grid, r * columns + q))
            lower = np.int64(load8(grid, (r + 1) * columns + q))
            s0 += int(upper & 0xFF)
            s1 += int(upper >> 8 & 0xFF)
            s2 += int(lower & 0xFF)
            s3 += int(lower >> 8 & 0xFF)
    sums[0], sums[1], sums[2], sums[3] = s0, s1, s2, s3
    return int(2 * cells.shape[1])


@part
def is_excluded(
    goal: Goal, num_angles: int, found: Integers, group: tuple[int, int], shift: tuple[int, int],
    extra: int,
) -> bool:  # fmt: skip
    """Whether a whole block is near the best pose.

    ``group``: first angle and number of angles; ``shift``: first (column, row), ``extra`` more.
    """
    for a in (group[0], min(group[0] + group[1], num_angles) - 1):
        da = abs(a - found[0, 1])
        if goal.circular:
            da = min(da, num_angles - da)
        if da > goal.turns:
            return False
    dj = max(abs(shift[0] - found[0, 2]), abs(shift[0] + extra - found[0, 2]))
    di = max(abs(shift[1] - found[0, 3]), abs(shift[1] + extra - found[0, 3]))
    return bool(max(dj, di) <= goal.separation)
