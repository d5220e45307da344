# SPDX-License-Identifier: Apache-2.0
"""Probability grids built from scans by ray carving; scans are matched against them.

A cell holds a uint16: 0 where nothing is known, else 1..LEVELS, linear in the occupancy
probability P_MIN..P_MAX. A hit (miss) multiplies the odds by those of p_hit (p_miss), which is
one table look-up per cell. The lattice is fixed: cell (i, j) covers x in
[j, j + 1) * resolution and y in [i, i + 1) * resolution of the submap frame, so a grid that grows
changes none of its cells.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params
from rlml_slam.compiled import brief, kernel, part
from rlml_slam.errors import InputError
from rlml_slam.matching import surfaces
from rlml_slam.se2 import Array

P_MIN, P_MAX = 0.1, 0.97
LEVELS = 32767
STEP = (P_MAX - P_MIN) / (LEVELS - 1)
MARGIN = 64  # cells of slack when a grid grows, and of free border that kernels may read
BORDER = 4
TOUCHED = np.uint16(0x8000)
WHOLE_RAY = 2.0**40  # a ray's length as an integer
FEWEST = 64  # of so many rays, one is followed from the sensor on
CLOSE = 0.99  # [cells] between two rays, so that a cell does not fit in between
DIAGONAL = 1.5  # [cells] that one cell covers of a ray at most
ENDS = 3.0 * DIAGONAL  # [cells] of the last cells of a ray, which it does not miss, and one more
EMPTY = np.zeros(0, dtype=np.int32)
FIRST_LIST = 4096


def value_of(p: float | Array) -> NDArray[np.uint16]:
    """Cell value of a probability (clamped)."""
    p = np.clip(p, P_MIN, P_MAX)
    return np.asarray(1 + np.rint((p - P_MIN) / STEP), dtype=np.uint16)


def probability_of(values: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Occupancy probability of cell values, NaN where nothing is known."""
    p = P_MIN + (values.astype(np.float32) - 1) * STEP
    return np.where(values == 0, np.float32(np.nan), p).astype(np.float32)


@lru_cache(maxsize=8)
def update_table(p_update: float) -> NDArray[np.uint16]:
    """New value (LEVELS + 1,) of every value after one observation of probability p_update."""
    p = P_MIN + np.arange(LEVELS) * STEP
    odds = p / (1.0 - p) * (p_update / (1.0 - p_update))
    return np.concatenate([value_of(np.array([p_update])), value_of(odds / (1.0 + odds))])


class Submap:
    """A probability grid in its own frame that grows on demand.

    ``values`` (rows = y, columns = x) uint16, ``corner`` the lattice indices (column, row) of
    values[0, 0], ``insertions`` the number of scans in it. ``version`` changes with every
    insertion, so that products (search pyramids) know when they are stale.
    """

    def __init__(self, parameters: params.Submap | None = None) -> None:
        self.parameters = parameters or params.Submap()
        self.resolution = self.parameters.resolution
        self.values = np.zeros((0, 0), dtype=np.uint16)
        self.corner = (0, 0)
        self.insertions = 0
        self._hit = update_table(self.parameters.p_hit)
        self._miss = update_table(self.parameters.p_miss)
        self._list = EMPTY

    @property
    def version(self) -> int:
        """Number that changes whenever a cell may have changed."""
        return self.insertions

    @property
    def bounds(self) -> Array:
        """Extent (x_min, y_min, x_max, y_max) [m] of the allocated grid in the submap frame."""
        (j, i), (rows, columns) = self.corner, self.values.shape
        return np.array([j, i, j + columns, i + rows], dtype=np.float64) * self.resolution

    def probability(self) -> NDArray[np.float32]:
        """Occupancy probability (rows, columns), NaN where nothing is known."""
        return probability_of(self.values)

    def insert(self, points: Array, origin: Array) -> None:
        """Add one scan: ``points`` (n, 2) end points and ``origin`` (2,) sensor, submap frame.

        The cells between the sensor and an end point miss, the end point's cell is hit; within
        one insertion a cell counts once, and hits win. Points are in scan order: gaps between
        neighbours on one surface are filled (:mod:`surfaces`). Raises InputError for a value
        that is not finite.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        origin = np.ascontiguousarray(origin, dtype=np.float64).reshape(2)
        x_min, y_min, x_max, y_max = extent(points, origin)
        if not (math.isfinite(x_max - x_min) and math.isfinite(y_max - y_min)):
            raise InputError('scan for a submap has an end point or origin that is not finite')
        self._cover(x_min, y_min, x_max, y_max)
        j, i = self.corner
        points = surfaces.fill(points, self.resolution)
        while True:
            used = carve(
                self.values, points, origin, float(j), float(i), 1.0 / self.resolution,
                self._hit, self._miss, self._list,
            )  # fmt: skip
            if used >= 0:
                break
            self._list = np.zeros(max(2 * len(self._list), FIRST_LIST), dtype=np.int32)
        self.insertions += 1

    def complete(self) -> None:
        """Let go of what only insertions need: the list of cells, and the margin to grow into."""
        self._list = EMPTY
        known = self.values != 0
        rows, columns = np.flatnonzero(known.any(1)), np.flatnonzero(known.any(0))
        if len(rows):
            first, end = max(rows[0] - BORDER, 0), rows[-1] + BORDER + 1
            left, right = max(columns[0] - BORDER, 0), columns[-1] + BORDER + 1
            self.values = self.values[first:end, left:right].copy()
            self.corner = (self.corner[0] + int(left), self.corner[1] + int(first))

    def walls(self) -> Array:
        """Middles (n, 2) of the cells that stop beams more often than not, submap frame."""
        return walls_of(self.values, *self.corner, self.resolution, int(value_of(0.5)))

    def knows(self, points: Array) -> float:
        """Share of points (n, 2) that lie in cells that something is known of."""
        known = count_known(self.values, *self.corner, self.resolution, points)
        return known / max(len(points), 1)

    def _cover(self, x_min: float, y_min: float, x_max: float, y_max: float) -> None:
        """Grow the grid until the box and a border around it are inside."""
        scale = 1.0 / self.resolution
        j_min, j_max = math.floor(x_min * scale) - BORDER, math.floor(x_max * scale) + BORDER + 1
        i_min, i_max = math.floor(y_min * scale) - BORDER, math.floor(y_max * scale) + BORDER + 1
        (j, i), (rows, columns) = self.corner, self.values.shape
        if self.values.size:
            if j <= j_min and i <= i_min and j_max <= j + columns and i_max <= i + rows:
                return
            new_j, new_i = min(j, j_min), min(i, i_min)
            end_j, end_i = max(j + columns, j_max), max(i + rows, i_max)
            new_j -= MARGIN * (new_j < j)
            new_i -= MARGIN * (new_i < i)
            end_j += MARGIN * (end_j > j + columns)
            end_i += MARGIN * (end_i > i + rows)
        else:
            j, i = j_min, i_min
            new_j, new_i, end_j, end_i = j_min, i_min, j_max, i_max
        grown = np.zeros((end_i - new_i, end_j - new_j), dtype=np.uint16)
        grown[i - new_i : i - new_i + rows, j - new_j : j - new_j + columns] = self.values
        self.values, self.corner = grown, (new_j, new_i)


@kernel
def walls_of(
    values: NDArray[np.uint16], corner_j: int, corner_i: int, resolution: float, least: int
) -> Array:
    """Middles (n, 2) of the cells with more than ``least``, row by row."""
    rows, columns = values.shape
    count = 0
    for i in range(rows):
        for j in range(columns):
            count += int(values[i, j] > least)
    out = np.empty((count, 2))
    n = 0
    for i in range(rows):
        for j in range(columns):
            if values[i, j] > least:
                out[n, 0] = (j + corner_j + 0.5) * resolution
                out[n, 1] = (i + corner_i + 0.5) * resolution
                n += 1
    return out


@brief
def count_known(
    values: NDArray[np.uint16], corner_j: int, corner_i: int, resolution: float, points: Array
) -> int:
    """How many of the points (n, 2) lie in cells that are not 0."""
    rows, columns = values.shape
    count = 0
    for k in range(len(points)):
        j = int(np.floor(points[k, 0] / resolution)) - corner_j
        i = int(np.floor(points[k, 1] / resolution)) - corner_i
        count += int(0 <= i < rows and 0 <= j < columns and values[i, j] != 0)
    return count


@brief
def extent(points: Array, origin: Array) -> tuple[float, float, float, float]:
    """Box (x_min, y_min, x_max, y_max) of the end points and the origin; NaN if any is NaN."""
    x_min = x_max = origin[0]
    y_min = y_max = origin[1]
    total = 0.0
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        total += x + y
        x_min, x_max = min(x_min, x), max(x_max, x)
        y_min, y_max = min(y_min, y), max(y_max, y)
    if not np.isfinite(total + origin[0] + origin[1]):
        return np.nan, np.nan, np.nan, np.nan
    return x_min, y_min, x_max, y_max


@kernel
def carve(
    values: NDArray[np.uint16],
    points: Array,
    origin: Array,
    corner_j: float,
    corner_i: float,
    scale: float,
    hit: NDArray[np.uint16],
    miss: NDArray[np.uint16],
    touched: NDArray[np.int32],
) -> int:
    """Apply one scan to ``values``; number of cells touched, or -1 if ``touched`` is too short.

    ``points`` (n, 2) are end points in scan order. Every touched cell is marked with the top bit
    and listed, and unmarked at the end; the length of the list is checked before anything is
    changed.
    """
    columns = values.shape[1]
    flat = values.reshape(-1)
    x0, y0 = origin[0] * scale - corner_j, origin[1] * scale - corner_i
    rays = np.empty((len(points), 2))
    for k in range(len(points)):
        rays[k, 0] = points[k, 0] * scale - corner_j - x0
        rays[k, 1] = points[k, 1] * scale - corner_i - y0
    starts = uncovered(rays)
    # upper bound on touched cells: each ray crosses |di| + |dj| + 1 cells
    bound = 0
    for k in range(len(points)):
        share = 1.0 - starts[k]
        bound += int(abs(rays[k, 0]) * share) + int(abs(rays[k, 1]) * share) + 4
    if min(bound, flat.size) > touched.size:
        return -1
    n = 0
    for k in range(len(points)):
        x1, y1 = points[k, 0] * scale - corner_j, points[k, 1] * scale - corner_i
        cell = int(np.floor(y1)) * columns + int(np.floor(x1))
        v = flat[cell]
        if v < TOUCHED:
            flat[cell] = hit[v] | TOUCHED
            touched[n] = cell
            n += 1
    hits = n
    for k in range(len(points)):
        x1, y1 = points[k, 0] * scale - corner_j, points[k, 1] * scale - corner_i
        sx, sy = x0 + starts[k] * (x1 - x0), y0 + starts[k] * (y1 - y0)
        n = touch_ray(flat, columns, sx, sy, x1, y1, touched, n)
    for m in range(hits):
        flat[touched[m]] ^= TOUCHED
    for m in range(hits, n):
        at = np.uint64(touched[m])
        flat[at] = miss[np.uint64(flat[at] ^ TOUCHED)]
    return n


@part
def uncovered(rays: Array) -> Array:
    """Share (n,) of each ray up to which the cells that it crosses are crossed by others as well.

    ``rays`` (n, 2) [cells] from one origin, in the order of their angles or nearly so. A cell
    that a ray crosses between two others is crossed by one of these, too, wherever they are less
    than the side of a cell apart: it would not fit in between. So of rays 0, 8, 16 ... all is
    needed, of 4, 12 ... what lies beyond where their neighbours 4 away are that close, of 2, 6
    ... beyond where those 2 away are, and so on: near the sensor, few rays do for all.
    """
    n = len(rays)
    length, share = np.empty(n), np.zeros(n)
    for k in range(n):
        length[k] = math.hypot(rays[k, 0], rays[k, 1])
    stride = 1
    while stride <= FEWEST // 2:
        for k in range(stride, n - stride, 2 * stride):
            a, b = k - stride, k + stride
            ax, ay, bx, by = rays[a, 0], rays[a, 1], rays[b, 0], rays[b, 1]
            dot, cross = ax * bx + ay * by, ax * by - ay * bx
            before = ax * rays[k, 1] - ay * rays[k, 0]
            after = rays[k, 0] * by - rays[k, 1] * bx
            if dot <= 0.0 or before * after < 0.0 or length[k] == 0.0:
                continue
            reach = min(length[a], length[b]) - ENDS
            if abs(cross) * reach > CLOSE * dot:  # twice the tangent of half the angle is less
                reach = CLOSE * dot / abs(cross)
            share[k] = max(reach - DIAGONAL, 0.0) / length[k]
        stride *= 2
    return share


@kernel
def touch_ray(
    flat: NDArray[np.uint16],
    columns: int,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    touched: NDArray[np.int32],
    n: int,
) -> int:
    """Mark and list the cells from (x0, y0) to (x1, y1) [cells], but the last two (Amanatides).

    The cell before the end point's is not known to be free: the wall's noise reaches into it, and
    beams that graze the wall would wear off its near side. The loop has no branches, which no
    processor could predict: the place along the ray is an integer, and a cell that is marked
    already is overwritten by the next one in the list.
    """
    j, i = int(np.floor(x0)), int(np.floor(y0))
    dx, dy = x1 - x0, y1 - y0
    left = abs(int(np.floor(x1)) - j) + abs(int(np.floor(y1)) - i)
    step_j = 1 if dx > 0 else -1
    step_i = columns if dy > 0 else -columns
    per_j = 1.0 / abs(dx) if dx != 0 else np.inf
    per_i = 1.0 / abs(dy) if dy != 0 else np.inf
    first_j = ((j + 1 - x0) if dx > 0 else (x0 - j)) * per_j if dx != 0 else np.inf
    first_i = ((i + 1 - y0) if dy > 0 else (y0 - i)) * per_i if dy != 0 else np.inf
    # where along the ray the next column (row) begins; how far beyond its end does not matter
    next_j, next_i = int(min(first_j, 2.0) * WHOLE_RAY), int(min(first_i, 2.0) * WHOLE_RAY)
    width, height = int(min(per_j, 2.0) * WHOLE_RAY), int(min(per_i, 2.0) * WHOLE_RAY)
    cell, turn, both, ahead = i * columns + j, step_j - step_i, width + height, next_j - next_i
    for _ in range(left - 1):
        # unsigned: an index that may be negative is looked at twice
        at = np.uint64(cell)
        touched[np.uint64(n)] = cell
        v = flat[at]
        flat[at] = v | TOUCHED
        n += int(v < TOUCHED)
        sideways = ahead >> 63  # all bits where the next column begins first, or none
        cell = cell + step_i + (sideways & turn)
        ahead = (ahead - height) + (sideways & both)
    return n


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    submap.insert(np.array([[1.0, 0.5], [-0.5, 1.0]]), np.zeros(2))
    submap.knows(submap.walls())
