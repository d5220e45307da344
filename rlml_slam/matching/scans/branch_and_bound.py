# SPDX-License-Identifier: Apache-2.0
"""Correlative search in a large window: branch and bound (Hess et al. 2016, section V-B).

A block of 2^h x 2^h shifts is bounded by the largest cell that each end point can meet in it.
Blocks are divided by 8 x 8, not by 2 x 2: eight neighbours lie side by side in memory and are
summed up as one word, so 64 bounds cost little more than one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, load8, part
from rlml_slam.errors import InputError
from rlml_slam.matching.scans.submap import P_MAX, P_MIN, Submap
from rlml_slam.se2 import Array, wrap

BRANCH, BITS = 8, 3  # a block is divided into BRANCH x BRANCH = 2^BITS x 2^BITS
BYTES = 0x00FF00FF00FF00FF  # every second byte of a word, so that sums have 16 bits each
ROOT = BRANCH * BRANCH  # side of the largest blocks
BATCH = 1024  # of them that are divided before the best parts are searched
NUM_LEVELS = 3  # cells, blocks of side BRANCH, blocks of side ROOT
CARRY_FREE = 256  # bytes that can be summed in 16 bits


@dataclass(frozen=True)
class Candidate:
    """Pose (3,) of base in the submap frame with its mean hit probability there."""

    pose: Array
    score: float


@dataclass(frozen=True)
class WideResult:
    """The best pose of a wide search and the best one well separated from it, None if too weak."""

    best: Candidate | None
    second: Candidate | None
    evaluated: int


class Pyramid:
    """Max-pooled grids of one submap for branch and bound.

    Level k bounds blocks of side 8^k: its value at [i, j] is the largest of the side x side cells
    from (i, j) on, quantised to a byte (0 = unknown or P_MIN, 255 = P_MAX). ``levels`` (3, rows *
    columns) are padded by a block of the top level on each side, so that a block which begins or
    ends outside is bounded too; in a row, the columns of neighbouring blocks are side by side
    (see :func:`offset`).
    """

    def __init__(self, submap: Submap) -> None:
        self.resolution = submap.resolution
        self.version = submap.version
        self.corner = (submap.corner[0] - ROOT, submap.corner[1] - ROOT)
        height, width = submap.values.shape
        self.rows, self.columns = height + 2 * ROOT, (-(-width // ROOT) + 2) * ROOT
        grid = np.zeros((self.rows, self.columns), np.uint8)
        # values reach LEVELS = 2^15 - 1; 0 and 1 (unknown, P_MIN) become 0
        grid[ROOT : ROOT + height, ROOT : ROOT + width] = np.minimum(submap.values >> 7, 255)
        self.levels = np.empty((NUM_LEVELS, grid.size), np.uint8)
        self.levels[0] = grid.ravel()
        for k in range(1, NUM_LEVELS):
            side = BRANCH**k
            for h in range(BITS):
                grid = pool(grid, (side // BRANCH) << h)
            self.levels[k] = grid.reshape(self.rows, -1, side).swapaxes(1, 2).ravel()

    def bound(self, k: int, i: int, j: int) -> int:
        """The value of level k at row i and column j."""
        return int(self.levels[k, offset(self.columns, k * BITS, i, j)])


@kernel
def offset(columns: int, h: int, i: int, j: int) -> int:
    """Where row i, column j of the level with blocks of side 2^h is."""
    return i * columns + (j & ((1 << h) - 1)) * (columns >> h) + (j >> h)


def pool(grid: NDArray[np.uint8], shift: int) -> NDArray[np.uint8]:
    """Maximum of grid at (i, j), (i, j + shift), (i + shift, j), (i + shift, j + shift)."""
    wide = grid.copy()
    np.maximum(wide[:, :-shift], grid[:, shift:], out=wide[:, :-shift])
    tall = wide.copy()
    np.maximum(tall[:-shift], wide[shift:], out=tall[:-shift])
    return tall


def wide(
    pyramid: Pyramid,
    points: Array,
    pose: Array,
    half_width: float,
    half_angle: float,
    min_score: float = 0.0,
    separation: float = 0.5,
    separation_angle: float = 0.3,
    second_share: float = 0.7,
) -> WideResult:
    """Best pose on a lattice around ``pose`` (3,) by branch and bound, and the best other one.

    ``points`` (n, 2) in the base frame; scores are mean hit probabilities at the nearest cells.
    Shifts are whole cells within ``half_width`` [m], angles steps that move the far end points
    by about a cell within ``half_angle`` (>= pi: all around). The second candidate differs by
    more than ``separation`` [m] in x or y or by more than ``separation_angle``, and is
    looked for down to ``second_share`` of the best score. Candidates below ``min_score`` are None.
    Raises InputError for no points.
    """
    if not len(points):
        raise InputError('wide search: the scan has no points')
    points = np.ascontiguousarray(points, dtype=np.float64)
    thetas = angles(points, pyramid.resolution, half_angle)
    n = round(half_width / pyramid.resolution)
    unit = 255.0 * len(points) / (P_MAX - P_MIN)  # sum of cells per score
    threshold = math.ceil((min_score - P_MIN) * unit) - 1
    least = np.array([(second_share - 1.0) * P_MIN * unit, second_share])
    found = np.empty((2, 4), dtype=np.int64)
    turns = separation_angle / (thetas[1] - thetas[0]) if len(thetas) > 1 else math.inf
    evaluated = branch_and_bound(
        pyramid.levels, pyramid.rows, pyramid.columns, pyramid.corner[0], pyramid.corner[1],
        1.0 / pyramid.resolution, points, np.ascontiguousarray(pose, dtype=np.float64), thetas, n,
        max(threshold, -1), separation / pyramid.resolution, turns, half_angle >= math.pi, least,
        found,
    )  # fmt: skip

    def candidate(row: NDArray[np.int64]) -> Candidate | None:
        if row[0] < 0:
            return None
        shift = row[2:4] * pyramid.resolution
        at = (pose[0] + shift[0], pose[1] + shift[1], float(wrap(pose[2] + thetas[row[1]])))
        score = P_MIN + float(row[0]) / unit
        return Candidate(np.array(at), score)

    return WideResult(candidate(found[0]), candidate(found[1]), evaluated)


def angles(points: Array, resolution: float, half_angle: float) -> Array:
    """Angles searched (m,), relative: a step moves the 90th percentile of ranges by a cell."""
    reach = max(_quantile(np.sort(np.hypot(points[:, 0], points[:, 1])), 0.9), 1.0)
    step = resolution / reach
    if half_angle >= math.pi:
        m = math.ceil(2.0 * math.pi / step)
        return np.arange(m, dtype=np.float64) * (2.0 * math.pi / m)
    m = math.ceil(half_angle / step)
    return np.arange(-m, m + 1, dtype=np.float64) * (half_angle / max(m, 1))


def _quantile(ordered: Array, share: float) -> float:
    """That of values (n,) in order, linear between neighbours; np.quantile takes 100 us."""
    k, rest = divmod((len(ordered) - 1) * share, 1.0)
    a, b = ordered[[int(k), min(int(k) + 1, len(ordered) - 1)]].tolist()
    return float(b - (b - a) * (1.0 - rest) if rest >= 0.5 else a + (b - a) * rest)


@kernel
def branch_and_bound(
    levels: NDArray[np.uint8],
    rows: int,
    columns: int,
    corner_j: int,
    corner_i: int,
    scale: float,
    points: Array,
    pose: Array,
    thetas: Array,
    n: int,
    threshold: int,
    separation: float,
    separation_turns: float,
    circular: bool,
    least: Array,
    found: NDArray[np.int64],
) -> int:
    """Rows of ``found``: (sum, angle index, column shift, row shift) of best and second, -1 none.

    ``least`` (2,) = (a, b): the second has to have more than a + b * (sum of the best). Returns
    the number of poses and blocks evaluated.
    """
    cells = cells_of(points, pose, thetas, scale, corner_j, corner_i)
    tiles = (2 * n + ROOT) // ROOT
    roots = np.full(len(thetas) * tiles * tiles, CARRY_FREE * len(points))
    order = np.arange(len(roots))
    evaluated = 0
    if len(roots) > BATCH:  # of fewer, nearly all are divided anyway
        for m in range(len(roots)):
            a, tile = divmod(m, tiles * tiles)
            i, j = divmod(tile, tiles)
            roots[m] = block_sum(levels[2], rows, columns, cells[a], j * ROOT - n, i * ROOT - n)
        order = np.argsort(-roots, kind='mergesort')
        evaluated = len(roots)
    blocks = np.empty((min(BATCH, len(roots)) * BRANCH * BRANCH, 4), dtype=np.int32)
    sums = np.empty(BRANCH * BRANCH, dtype=np.int64)
    offsets = np.empty(len(points), dtype=np.int64)
    count = 0
    for rank in range(2):
        found[rank] = -1
        best = threshold
        if rank == 1:
            if found[0, 0] < 0:
                break
            best = max(threshold, int(np.floor(least[0] + least[1] * found[0, 0])))
        for start in range(0, len(roots), BATCH):
            if rank == 0 or len(roots) > BATCH:  # else those of the first search are all there
                count = 0
                for m in order[start : start + BATCH]:
                    if roots[m] <= best:
                        break
                    a, tile = divmod(int(m), tiles * tiles)
                    i, j = tile // tiles * ROOT - n, tile % tiles * ROOT - n
                    evaluated += divide(
                        levels[1], rows, columns, BITS, cells[a], j, i, n, offsets, sums
                    )
                    for k in range(len(sums)):
                        if sums[k] > best:
                            blocks[count, 0], blocks[count, 1] = sums[k], a
                            blocks[count, 2] = j + k % BRANCH * BRANCH
                            blocks[count, 3] = i + k // BRANCH * BRANCH
                            count += 1
            for b in np.argsort(-blocks[:count, 0], kind='mergesort'):
                if blocks[b, 0] <= best:
                    break
                a, j, i = int(blocks[b, 1]), int(blocks[b, 2]), int(blocks[b, 3])
                if rank == 1 and excluded(
                    found[0], a, j, i, BRANCH - 1, len(thetas), separation, separation_turns,
                    circular,
                ):  # fmt: skip
                    continue
                evaluated += divide(levels[0], rows, columns, 0, cells[a], j, i, n, offsets, sums)
                for k in range(len(sums)):
                    q, r = j + k % BRANCH, i + k // BRANCH
                    if sums[k] <= best or (
                        rank == 1
                        and excluded(
                            found[0], a, q, r, 0, len(thetas), separation, separation_turns,
                            circular,
                        )
                    ):  # fmt: skip
                        continue
                    best = sums[k]
                    found[rank, 0], found[rank, 1] = best, a
                    found[rank, 2], found[rank, 3] = q, r
    return evaluated


@part
def cells_of(
    points: Array, pose: Array, thetas: Array, scale: float, corner_j: int, corner_i: int
) -> NDArray[np.int32]:
    """Cells (angles, n, 2) of the points at each angle, (column, row) of the padded grid."""
    cells = np.empty((len(thetas), len(points), 2), dtype=np.int32)
    for a in range(len(thetas)):
        c, s = np.cos(pose[2] + thetas[a]), np.sin(pose[2] + thetas[a])
        for k in range(len(points)):
            px, py = points[k, 0], points[k, 1]
            cells[a, k, 0] = int(np.floor((pose[0] + c * px - s * py) * scale)) - corner_j
            cells[a, k, 1] = int(np.floor((pose[1] + s * px + c * py) * scale)) - corner_i
    return cells


@part
def block_sum(
    level: NDArray[np.uint8],
    rows: int,
    columns: int,
    cells: NDArray[np.int32],
    j: int,
    i: int,
) -> int:
    """Sum over the points of the top level's value at their cells shifted by (j, i)."""
    total = 0
    for k in range(len(cells)):
        q, r = cells[k, 0] + j, cells[k, 1] + i
        if 0 <= q < columns and 0 <= r < rows:
            total += level[offset(columns, 2 * BITS, r, q)]
    return total


@part
def divide(
    level: NDArray[np.uint8],
    rows: int,
    columns: int,
    h: int,
    cells: NDArray[np.int32],
    j: int,
    i: int,
    n: int,
    offsets: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> int:
    """Block sums (64,) of the 8 x 8 blocks of side 2^h from shift (j, i) on; how many there are.

    Those that begin beyond the window, at a shift of more than ``n``, get -1.
    """
    inside = 0
    reach = (BRANCH - 1) << h
    for k in range(len(cells)):
        q, r = cells[k, 0] + j, cells[k, 1] + i
        if 0 <= q < columns - reach and 0 <= r < rows - reach:
            offsets[inside] = offset(columns, h, r, q)
            inside += 1
    sums[:] = 0
    width = min(((n - j) >> h) + 1, BRANCH)
    height = min(((n - i) >> h) + 1, BRANCH)
    down, half = columns << h, np.uint64(8)
    evens = np.uint64(BYTES)
    for r in range(0, BRANCH, 4):  # four rows at once: as many sums as there are registers for
        for first in range(0, inside, CARRY_FREE):
            even_0 = even_1 = even_2 = even_3 = np.uint64(0)
            odd_0 = odd_1 = odd_2 = odd_3 = np.uint64(0)
            for k in range(first, min(first + CARRY_FREE, inside)):
                at = offsets[k] + r * down
                word = load8(level, at)
                even_0 += word & evens
                odd_0 += (word >> half) & evens
                word = load8(level, at + down)
                even_1 += word & evens
                odd_1 += (word >> half) & evens
                word = load8(level, at + 2 * down)
                even_2 += word & evens
                odd_2 += (word >> half) & evens
                word = load8(level, at + 3 * down)
                even_3 += word & evens
                odd_3 += (word >> half) & evens
            spread(even_0, odd_0, sums[BRANCH * r :])
            spread(even_1, odd_1, sums[BRANCH * (r + 1) :])
            spread(even_2, odd_2, sums[BRANCH * (r + 2) :])
            spread(even_3, odd_3, sums[BRANCH * (r + 3) :])
    for r in range(BRANCH):
        for q in range(BRANCH):
            if r >= height or q >= width:
                sums[BRANCH * r + q] = -1
    return width * height


@part
def spread(even: np.uint64, odd: np.uint64, sums: NDArray[np.int64]) -> None:
    """Add the sums that lie side by side in two words to the first eight of ``sums``."""
    for q in range(0, BRANCH, 2):
        shift = np.uint64(8 * q)
        sums[q] += np.int64((even >> shift) & np.uint64(0xFFFF))
        sums[q + 1] += np.int64((odd >> shift) & np.uint64(0xFFFF))


@part
def excluded(
    best: NDArray[np.int64],
    a: int,
    j: int,
    i: int,
    extra: int,
    num_angles: int,
    separation: float,
    separation_turns: float,
    circular: bool,
) -> bool:
    """Whether the whole block (j..j + extra, i..i + extra) at angle a is near the best pose."""
    da = abs(a - best[1])
    if circular:
        da = min(da, num_angles - da)
    if da > separation_turns:
        return False
    dj = max(abs(j - best[2]), abs(j + extra - best[2]))
    di = max(abs(i - best[3]), abs(i + extra - best[3]))
    return bool(dj <= separation and di <= separation)


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    wide(Pyramid(submap), points, np.zeros(3), 0.2, 0.1)
