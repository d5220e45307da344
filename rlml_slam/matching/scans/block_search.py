# SPDX-License-Identifier: Apache-2.0
"""Kernels of branch and bound: all of the largest blocks, then parts of the best ones.

The bound of a block is the sum of the pooled cells that its end points can meet. All blocks of
8 x 8 shifts and four angles are bounded, 64 neighbours at a time. Those that may hold a better
pose than what was found are divided, best first: into 4 x 4 shifts and two angles, 2 x 2 shifts
and one, and single poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, load8, part
from rlml_slam.matching.scans.byte_sums import sum_lanes
from rlml_slam.matching.scans.search_pyramid import (
    BEFORE,
    FULL,
    LANES,
    UNIT,
    Level,
    Levels,
    place,
)

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
    """Criteria in sums of cells; the second needs more than ``offset`` + ``share`` * the best."""

    threshold: int
    offset: float
    share: float
    separation: float
    turns: float
    circular: bool
    budget: int


class Table(NamedTuple):
    """Where the bounds of end points are, for each group of ``span`` neighbouring angles.

    ``offsets`` (groups, n) in the data of a level and ``first`` (groups, n, 2) cells (column, row)
    at the first shift, of which ``counts`` (groups,) are used: the others move too far within the
    group, and count as hits. ``box`` (groups, 4) is the extent (column, row) of the first cells.
    """

    span: int
    offsets: Integers
    first: NDArray[np.int32]
    counts: Integers
    box: Integers


class Parts(NamedTuple):
    """What a block is divided with."""

    levels: Levels
    lattice: Lattice
    goal: Goal
    four: Table
    two: Table


@part
def tabulate(level: Level, cells: NDArray[np.int32], span: int) -> Table:
    """The table of a level for groups of ``span`` angles."""
    m, n = cells.shape[0], cells.shape[1]
    groups = (m + span - 1) // span
    offsets, counts = np.empty((groups, n), np.int64), np.zeros(groups, np.int64)
    first, box = np.empty((groups, n, 2), np.int32), np.zeros((groups, 4), np.int64)
    for g in range(groups):
        box[g, :2], box[g, 2:] = 1 << 30, -(1 << 30)
        for k in range(n):
            j0, i0 = cells[g * span, k, 0], cells[g * span, k, 1]
            j1, i1 = j0, i0
            for a in range(g * span + 1, min((g + 1) * span, m)):
                j, i = cells[a, k, 0], cells[a, k, 1]
                j0, j1, i0, i1 = min(j0, j), max(j1, j), min(i0, i), max(i1, i)
            at = place(level, i0, j0, max(i1 - i0, j1 - j0))
            if at < 0:
                continue
            offsets[g, counts[g]] = at
            first[g, counts[g], 0], first[g, counts[g], 1] = j0, i0
            box[g, 0], box[g, 1] = min(box[g, 0], j0), min(box[g, 1], i0)
            box[g, 2], box[g, 3] = max(box[g, 2], j0), max(box[g, 3], i0)
            counts[g] += 1
    return Table(span, offsets, first, counts, box)


@part
def reachable(
    levels: Levels, table: Table, g: int, shift: tuple[int, int], lanes: int
) -> Integers:
    """Offsets of the end points of group ``g`` that may meet a cell of the grid at a shift.

    ``shift`` (columns, rows); ``lanes`` are the blocks to the right that are looked up too.
    """
    n, box, left = table.counts[g], table.box[g], -SIDE * (lanes - 1)
    right, top = levels.width + BEFORE, levels.rows + BEFORE
    offsets: Integers = table.offsets[g][:n]
    if (
        box[0] + shift[0] >= left
        and box[1] + shift[1] >= 0
        and box[2] + shift[0] < right
        and box[3] + shift[1] < top
    ):
        return offsets
    some, count = np.empty(n, np.int64), 0
    for k in range(n):
        j, i = table.first[g, k, 0] + shift[0], table.first[g, k, 1] + shift[1]
        if left <= j < right and 0 <= i < top:
            some[count] = offsets[k]
            count += 1
    return some[:count]


@part
def sweep(levels: Levels, lattice: Lattice, table: Table, goal: Goal) -> tuple[Integers, int]:
    """Largest blocks that may hold a pose above the threshold, best first; the look-ups made.

    A block is (bound, group of angles, row, column) as one number, see packed().
    """
    rows, columns = lattice.allowed.shape
    blocks, count, lookups = np.empty(1024, np.int64), 0, 0
    sums = np.empty(LANES, np.uint16)
    for g in range(len(table.counts)):
        sure = FULL * (lattice.cells.shape[1] - table.counts[g])
        least = max(goal.threshold // UNIT + 1 - sure, 0)
        for i in range(rows):
            for j in range(0, columns, LANES):
                allowed = lattice.allowed[i, j : j + LANES]
                if lookups > goal.budget or not allowed.any():
                    continue
                offsets = reachable(levels, table, g, (SIDE * j, SIDE * i), LANES)
                shift = i * levels.eight.columns + j
                hits = sum_lanes(
                    levels.eight.data, offsets, np.int64(len(offsets)), np.int64(shift),
                    np.int64(least), sums,
                )  # fmt: skip
                lookups += len(offsets)
                if hits == 0:
                    continue
                if count + LANES > len(blocks):
                    blocks = np.append(blocks, np.empty(len(blocks), np.int64))
                for q in range(len(allowed)):
                    if (hits >> np.uint64(q)) & np.uint64(1) and allowed[q]:
                        blocks[count] = packed(sums[q] + sure, g, i, j + q)
                        count += 1
    return ranked(blocks[:count], FULL * lattice.cells.shape[1]), lookups


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
    parts = Parts(
        levels, lattice, goal, tabulate(levels.four, lattice.cells, 2),
        tabulate(levels.two, lattice.cells, 1),
    )  # fmt: skip
    for rank in range(2):
        best = goal.threshold
        if rank == 1:
            best = max(best, int(np.floor(goal.offset + goal.share * found[0, 0])))
        for block in blocks:
            rest, j = divmod(block, SHIFTS)
            rest, i = divmod(rest, SHIFTS)
            bound, g = divmod(rest, ANGLES)
            if UNIT * bound <= best or lookups > goal.budget:
                break
            if rank == 0 or not is_excluded(parts, found[0], (4 * g, 4), (8 * j, 8 * i), 7):
                lookups += divide(parts, (g, SIDE * j, SIDE * i), rank, best, found)
                best = max(best, found[rank, 0])
        if found[0, 0] < 0:
            break
    return lookups


@part
def divide(
    parts: Parts, block: tuple[int, int, int], rank: int, best: int, found: Integers
) -> int:
    """Search a block of side 8, (group, column, row), for a pose above ``best``; the look-ups."""
    g, j, i = block
    sums = np.full(8, -1, np.int64)
    lookups = 0
    for h in range(2):
        if 2 * g + h < len(parts.four.counts):
            lookups += quarters(
                parts.levels, parts.levels.four, parts.four, (2 * g + h, j, i), sums[4 * h :]
            )
    while True:
        k = int(np.argmax(sums))
        if UNIT * sums[k] <= best:
            return lookups
        sums[k] = -1
        part_j, part_i = j + 4 * (k % 2), i + 4 * (k % 4 // 2)
        for a in range(4 * g + 2 * (k // 4), min(4 * g + 2 * (k // 4) + 2, len(parts.two.counts))):
            lookups += finish(parts, (a, part_j, part_i), rank, best, found)
            best = max(best, found[rank, 0])


@part
def finish(
    parts: Parts, block: tuple[int, int, int], rank: int, best: int, found: Integers
) -> int:
    """Search a block of side 4, (angle, column, row), for a pose above ``best``; the look-ups."""
    a, j, i = block
    sums, cells = np.empty(4, np.int64), np.empty(4, np.int64)
    lookups = quarters(parts.levels, parts.levels.two, parts.two, block, sums)
    most = parts.lattice.shifts
    for k in range(4):
        if UNIT * sums[k] <= best:
            continue
        first_j, first_i = j + 2 * (k % 2), i + 2 * (k // 2)
        lookups += poses(parts.levels, parts.lattice, (a, first_j, first_i), cells)
        for c in range(4):
            q, r = first_j + c % 2, first_i + c // 2
            if cells[c] <= best or q > most[0] or r > most[1]:
                continue
            if rank == 0 or not is_excluded(parts, found[0], (a, 1), (q, r), 0):
                best = cells[c]
                found[rank, 0], found[rank, 1] = best, a
                found[rank, 2], found[rank, 3] = q, r
    return lookups


@part
def quarters(
    levels: Levels, level: Level, table: Table, block: tuple[int, int, int], sums: Integers
) -> int:
    """Bounds (4,) of the quarters of a block, (group, column, row), row by row; the look-ups."""
    g, j, i = block
    offsets = reachable(levels, table, g, (j, i), 1)
    shift = i // level.side * level.columns + j // level.side
    sums[:4] = FULL * (table.offsets.shape[1] - table.counts[g])
    for first in range(0, len(offsets), UNIT):
        total = np.uint32(0)
        for k in range(first, min(first + UNIT, len(offsets))):
            # two values of this row and, in the upper bits, two of the row below
            word = np.uint32(load8(level.data, offsets[k] + shift))
            total += (word & np.uint32(0x0F0F)) | ((word & np.uint32(0xF0F0)) << np.uint32(12))
        for q in range(4):
            sums[q] += (total >> np.uint32(8 * q)) & np.uint32(0xFF)
    return len(offsets)


@part
def poses(levels: Levels, lattice: Lattice, block: tuple[int, int, int], sums: Integers) -> int:
    """Sums (4,) of 2 x 2 poses from (angle, column, row) on, row by row; the look-ups."""
    a, j, i = block
    right, top = levels.width + BEFORE, levels.rows + BEFORE
    sums[:] = 0
    for k in range(lattice.cells.shape[1]):
        q, r = lattice.cells[a, k, 0] + j, lattice.cells[a, k, 1] + i
        if 0 <= q < right and 0 <= r < top:
            upper = np.int64(load8(levels.cells, r * levels.columns + q))
            lower = np.int64(load8(levels.cells, (r + 1) * levels.columns + q))
            sums[0] += upper & 0xFF
            sums[1] += upper >> 8 & 0xFF
            sums[2] += lower & 0xFF
            sums[3] += lower >> 8 & 0xFF
    return int(2 * lattice.cells.shape[1])


@part
def is_excluded(
    parts: Parts, best: Integers, group: tuple[int, int], shift: tuple[int, int], extra: int
) -> bool:
    """Whether a whole block is near the best pose.

    ``group``: first angle and number of angles; ``shift``: first (column, row), ``extra`` more.
    """
    goal, num_angles = parts.goal, parts.lattice.cells.shape[0]
    for a in (group[0], min(group[0] + group[1], num_angles) - 1):
        da = abs(a - best[1])
        if goal.circular:
            da = min(da, num_angles - da)
        if da > goal.turns:
            return False
    dj = max(abs(shift[0] - best[2]), abs(shift[0] + extra - best[2]))
    di = max(abs(shift[1] - best[3]), abs(shift[1] + extra - best[3]))
    return bool(max(dj, di) <= goal.separation)
