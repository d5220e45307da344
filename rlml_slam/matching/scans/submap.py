# SPDX-License-Identifier: Apache-2.0
"""Probability grids built from scans by ray carving; scans are matched against them.

A cell holds a uint16: 0 where nothing is known, else 1..LEVELS, what a match reads of it, linear
from P_MIN to P_MAX. That is its occupancy probability, but a cell that was only missed reads as
free from the first miss on (eq. 68). A hit (miss) multiplies the odds by those of p_hit (p_miss),
which is one table look-up per cell. The lattice is fixed: cell (i, j) covers x in
[j, j + 1) * resolution and y in [i, i + 1) * resolution of the submap frame, so a grid that grows
changes none of its cells.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params
from rlml_slam.compiled import brief, kernel
from rlml_slam.errors import InputError
from rlml_slam.matching.scans import surfaces
from rlml_slam.matching.scans.ray_carving import Grid, carve
from rlml_slam.se2 import Array

P_MIN, P_MAX = 0.1, 0.97
LEVELS = 32767
STEP = (P_MAX - P_MIN) / (LEVELS - 1)
FREE = 0.12  # up to which a cell reads that was only missed
NEVER_HIT = (0.5 - P_MIN) / (FREE - P_MIN)  # its probability above P_MIN, by what it reads
MARGIN = 64  # cells of slack when a grid grows, and of free border that kernels may read
BORDER = 4
EMPTY = np.zeros(0, dtype=np.int32)
FIRST_LIST = 4096


def value_of(p: float | Array) -> NDArray[np.uint16]:
    """Cell value that reads as p (clamped)."""
    p = np.clip(p, P_MIN, P_MAX)
    return np.asarray(1 + np.rint((p - P_MIN) / STEP), dtype=np.uint16)


def probability_of(values: NDArray[np.uint16]) -> Array:
    """Occupancy probability of cell values, NaN where nothing is known."""
    read = P_MIN + (values.astype(np.float64) - 1.0) * STEP
    p = np.where(values <= FREE_VALUE, P_MIN + NEVER_HIT * (read - P_MIN), read)
    return np.where(values == 0, np.nan, p)


FREE_VALUE = int(value_of(FREE))  # up to which a cell was only missed


@lru_cache(maxsize=8)
def update_table(p_update: float) -> NDArray[np.uint16]:
    """New value (LEVELS + 1,) of every value after one observation of probability p_update.

    Cells that were only missed read P_MIN to FREE, and have P_MIN to 0.5 (eq. 68): beams cross the
    near side of a wall alone, and where its cells read more than the unknown ones behind it, the
    wall is drawn towards the robot. The less is seen of a wall, the more; one that sees a single
    wall, or a short part of two, would turn by tenths of a degree per metre.
    """
    values = np.arange(1, LEVELS + 1, dtype=np.uint16)
    p = probability_of(values)
    odds = p / (1.0 - p) * (p_update / (1.0 - p_update))
    after = np.append(p_update, odds / (1.0 + odds))
    read = value_of(after)
    if p_update > 0.5:  # a cell that was hit is not one that was only missed
        return np.maximum(read, FREE_VALUE + 1)
    free = np.append(True, values <= FREE_VALUE) | (read <= FREE_VALUE)
    return np.where(free, value_of(P_MIN + (after - P_MIN) / NEVER_HIT), read)


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
    def grid(self) -> Grid:
        """The cells as kernels take them."""
        return Grid(self.values, float(self.corner[0]), float(self.corner[1]), 1 / self.resolution)

    @property
    def bounds(self) -> Array:
        """Extent (x_min, y_min, x_max, y_max) [m] of the allocated grid in the submap frame."""
        (j, i), (rows, columns) = self.corner, self.values.shape
        return np.array([j, i, j + columns, i + rows], dtype=np.float64) * self.resolution

    def probability(self) -> Array:
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
        points, grid = surfaces.fill(points, self.resolution), self.grid
        while True:
            used = carve(grid, points, origin, self._hit, self._miss, self._list)
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


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    submap.insert(np.array([[1.0, 0.5], [-0.5, 1.0]]), np.zeros(2))
    submap.knows(submap.walls())
