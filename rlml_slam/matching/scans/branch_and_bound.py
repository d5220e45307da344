# SPDX-License-Identifier: Apache-2.0
"""Correlative search in a large window: branch and bound (Hess et al. 2016, section V-B).

The poses of the window are divided into blocks of 8 x 8 shifts and four angles. All of these are
bounded, 64 neighbours at a time. Those that may hold a better pose than what was found are divided
into halves, best first: 4 x 4 shifts and two angles, 2 x 2 shifts and one, single poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.errors import InputError
from rlml_slam.matching.scans.block_search import SIDE, Goal, Integers, Lattice, search
from rlml_slam.matching.scans.search_pyramid import BEFORE, Bytes, Pyramid
from rlml_slam.matching.scans.submap import P_MAX, P_MIN, Submap
from rlml_slam.se2 import Array, wrap

ENDLESS = 1 << 62  # look-ups of a search without a budget
LONGEST = 500.0  # [m] of a beam; angles of longer ones would fill the memory
OUTSIDE = 1 << 29  # [cells] beyond all grids; shifts are added to it in 32 bits


@dataclass(frozen=True)
class Candidate:
    """Pose (3,) of base in the submap frame with its mean hit probability there."""

    pose: Array
    score: float


@dataclass(frozen=True)
class Window:
    """The poses that are searched, around ``pose`` (3,).

    Shifts are whole cells within ``half_width`` (x, y) [m], angles within ``half_angle`` [rad]
    (>= pi: all around). With ``mapped``, a base that is not near a known cell is left out.
    """

    pose: Array
    half_width: tuple[float, float]
    half_angle: float
    mapped: bool = False


@dataclass(frozen=True)
class Criteria:
    """What is looked for, and how long.

    Candidates below ``min_score`` are not looked for. The second candidate differs from the best
    by more than ``separation`` [m] in x or y or by more than ``separation_angle`` [rad], and is
    looked for down to ``second_share`` of the best score. ``budget`` are look-ups of end points in
    the grid, of which a processor does about a thousand million in a second. Candidates from
    ``weak_score`` on (None: ``min_score``) are looked for too, while less than ``weak_budget``
    look-ups were made, but no second one.
    """

    min_score: float = 0.0
    separation: float = 0.5
    separation_angle: float = 0.3
    second_share: float = 0.7
    budget: int = ENDLESS
    weak_score: float | None = None
    weak_budget: int = ENDLESS


@dataclass(frozen=True)
class WideResult:
    """The best pose of a wide search and the best one well separated from it, None if too weak.

    ``lookups`` were made; the search is not ``complete`` if its budget did not suffice.
    """

    best: Candidate | None
    second: Candidate | None
    lookups: int
    complete: bool = True


def wide(
    pyramid: Pyramid, points: Array, window: Window, criteria: Criteria | None = None
) -> WideResult:
    """Best pose of ``points`` (n, 2), base frame, in a window, and the best other one.

    Scores are mean hit probabilities at the nearest cells. Angles are steps that move the far end
    points by about a cell. Raises InputError for no points.
    """
    if not len(points):
        raise InputError('wide search: the scan has no points')
    criteria = criteria or Criteria()
    points = np.ascontiguousarray(points, dtype=np.float64)
    thetas = angles(points, pyramid.resolution, window.half_angle)
    lattice = lattice_of(pyramid, points, window, thetas)
    unit = 255.0 * len(points) / (P_MAX - P_MIN)  # sum of cells per score
    turn = thetas[1] - thetas[0] if len(thetas) > 1 else math.inf
    weak_score = criteria.min_score if criteria.weak_score is None else criteria.weak_score
    threshold, weak = (
        max(math.ceil((score - P_MIN) * unit) - 1, -1)
        for score in (criteria.min_score, weak_score)
    )
    goal = Goal(
        threshold,
        (criteria.second_share - 1.0) * P_MIN * unit,
        criteria.second_share,
        criteria.separation / pyramid.resolution,
        criteria.separation_angle / turn,
        window.half_angle >= math.pi,
        criteria.budget,
        weak,
        criteria.weak_budget,
    )
    found = np.full((2, 4), -1, dtype=np.int64)
    lookups = search(pyramid.levels, lattice, goal, found)
    start = window.pose - np.array([*_half_shifts(pyramid, window), 0.0]) * pyramid.resolution

    def candidate(row: Integers) -> Candidate | None:
        if row[0] < 0:
            return None
        shift = row[2:4] * pyramid.resolution
        at = (start[0] + shift[0], start[1] + shift[1], float(wrap(start[2] + thetas[row[1]])))
        return Candidate(np.array(at), P_MIN + float(row[0]) / unit)

    complete = lookups <= criteria.budget
    return WideResult(candidate(found[0]), candidate(found[1]), lookups, complete)


def angles(points: Array, resolution: float, half_angle: float) -> Array:
    """Angles searched (m,), relative: a step moves the 90th percentile of ranges by a cell."""
    reach = max(1.0, min(LONGEST, _quantile(np.sort(np.hypot(*points.T)), 0.9)))  # of NaN too
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


def _half_shifts(pyramid: Pyramid, window: Window) -> tuple[int, int]:
    """Shifts (columns, rows) to each side of the window's pose."""
    x, y = window.half_width
    return round(x / pyramid.resolution), round(y / pyramid.resolution)


def lattice_of(pyramid: Pyramid, points: Array, window: Window, thetas: Array) -> Lattice:
    """The poses of a window, as cells of the padded grid."""
    half = _half_shifts(pyramid, window)
    (j, i), scale = pyramid.corner, 1.0 / pyramid.resolution
    first = np.array([j - BEFORE + half[0], i - BEFORE + half[1]])
    pose = np.ascontiguousarray(window.pose, dtype=np.float64)
    cells = cells_of(points, pose, thetas, scale, first)
    blocks = ((2 * half[1] + SIDE) // SIDE, (2 * half[0] + SIDE) // SIDE)
    allowed = np.ones(blocks, np.uint8)
    if window.mapped:
        base = np.floor(pose[:2] * scale).astype(np.int64) - first
        allowed = _near_known(pyramid.near, base[::-1] // SIDE, blocks)
    return Lattice(cells, (2 * half[0], 2 * half[1]), allowed)


def _near_known(near: Bytes, first: Integers, blocks: tuple[int, int]) -> NDArray[np.uint8]:
    """Blocks of shifts (rows, columns) that hold a base near what is known.

    ``first`` (row, column) is the block of the grid in which the first shift is; a block of shifts
    lies across two of the grid's in each direction.
    """
    out = np.zeros(blocks, np.uint8)
    rows, columns = (first[axis] + np.arange(blocks[axis]) for axis in (0, 1))
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        i, j = rows + di, columns + dj
        at_i, at_j = ((v >= 0) & (v < n) for v, n in zip((i, j), near.shape, strict=True))
        out[np.ix_(at_i, at_j)] |= near[np.ix_(i[at_i], j[at_j])]
    return out


@kernel
def cells_of(
    points: Array, pose: Array, thetas: Array, scale: float, first: Integers
) -> NDArray[np.int32]:
    """Cells (angles, n, 2) of the points at each angle, (column, row) less ``first`` (2,)."""
    cells = np.empty((len(thetas), len(points), 2), dtype=np.int32)
    for a in range(len(thetas)):
        c, s = np.cos(pose[2] + thetas[a]), np.sin(pose[2] + thetas[a])
        for k in range(len(points)):
            px, py = points[k, 0], points[k, 1]
            u = np.floor((pose[0] + c * px - s * py) * scale) - first[0]
            v = np.floor((pose[1] + s * px + c * py) * scale) - first[1]
            # numbers that no integer holds, and NaN, are in no grid
            is_cell = abs(u) < OUTSIDE and abs(v) < OUTSIDE
            cells[a, k, 0] = int(u) if is_cell else OUTSIDE
            cells[a, k, 1] = int(v) if is_cell else OUTSIDE
    return cells


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    wide(Pyramid(submap), points, Window(np.zeros(3), (0.2, 0.2), 0.1))
