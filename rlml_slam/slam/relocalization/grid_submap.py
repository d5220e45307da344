# SPDX-License-Identifier: Apache-2.0
"""The grid of a saved map as a submap that scans are matched with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params, se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.scans.scan_match import UNKNOWN
from rlml_slam.matching.scans.search_pyramid import Pyramid
from rlml_slam.matching.scans.submap import FREE_VALUE, P_MAX, P_MIN, Submap, value_of
from rlml_slam.se2 import Array

# A map that was saved knows occupied and free alone. The cells beside a wall, which a beam hits as
# often where the wall lies near their border, have become free: given back half of the wall's.
BESIDE = 50
WALL = 0.25  # probability from which a cell of the map may stop a beam
RUN = 10  # cells in line from which on a wall lies along the lattice
MAX_STEPS = 4096  # along a beam, 205 m in cells of 0.05 m: a message may have far smaller ones


@dataclass(frozen=True)
class GridSubmap:
    """``submap`` with the lattice of the grid, and ``T_map_submap`` (3,).

    The frames are the same where the grid is not turned and its origin is a multiple of the
    resolution, as those are that the back end draws. ``cov_cell`` (3, 3) is that of the error
    that all matches share, as walls lie anywhere in their cells, in the axes of the map.
    """

    submap: Submap
    T_map_submap: Array
    cov_cell: Array

    @property
    def yaw(self) -> float:
        """By which the submap is turned in the map [rad]."""
        return float(self.T_map_submap[2])

    @cached_property
    def pyramid(self) -> Pyramid:
        """Pooled grids for a search, built when it is first searched."""
        return Pyramid(self.submap)

    def from_map(self, poses: Array) -> Array:
        """Poses (..., 3) of the map frame in that of the submap."""
        return se2.between(self.T_map_submap, poses) if self.T_map_submap.any() else poses

    def to_map(self, poses: Array) -> Array:
        """The other way."""
        return se2.compose(self.T_map_submap, poses) if self.T_map_submap.any() else poses


def is_mapped(grid: OccupancyGrid) -> bool:
    """Whether there is anything in the grid that a scan could fit."""
    return bool((grid.cells > 0).any())


@lru_cache(maxsize=1)
def submap_of(grid: OccupancyGrid, parameters: params.Submap) -> GridSubmap:
    """A grid as a submap; unknown cells stay unknown. That of the latest grid is kept."""
    submap, cells = Submap(parameters), grid.cells
    submap.resolution = grid.resolution
    cov_cell = np.zeros((3, 3))
    if not ((cells > 0) & (cells < 100)).any():
        R = se2.rotation(grid.yaw)
        cov_cell[:2, :2] = R @ np.diag(grid.resolution**2 / 12.0 * along_lattice(cells)) @ R.T
        beside = np.where(_beside(cells) > 0, np.int8(BESIDE), np.int8(-1))
        cells = np.maximum(cells, beside)
    # of cells from 0 on, then of the unknown ones from -1 down
    known = np.clip(np.arange(128), 0, 100) / 100.0
    levels = value_of(P_MIN + (P_MAX - P_MIN) * known)
    levels[levels <= FREE_VALUE] = 1  # free for sure: of many beams, and not of the first misses
    submap.values = np.concatenate([levels, np.zeros(128, dtype=np.uint16)])[cells.view(np.uint8)]
    corner = se2.rotation(-grid.yaw) @ np.array(grid.origin)
    lattice = np.round(corner / grid.resolution)
    submap.corner = (int(lattice[0]), int(lattice[1]))
    rest = se2.rotation(grid.yaw) @ (corner - lattice * grid.resolution)
    return GridSubmap(submap, np.array([*rest, grid.yaw]), cov_cell)


def along_lattice(cells: NDArray[np.int8]) -> Array:
    """Share (2,) of the walls that fix x, and y, of which all cells lie in line.

    Such a wall is off by the same all along, uniformly within half a cell. One across the lattice
    is drawn as stairs, whose mean is where it stands.
    """
    from scipy import ndimage  # only for those who load a map

    walls = cells > 0
    upright, level = (ndimage.binary_opening(walls, np.ones(n)) for n in ((RUN, 1), (1, RUN)))
    both, number = np.count_nonzero(upright & level), np.count_nonzero(walls)
    lines = np.array([np.count_nonzero(upright), np.count_nonzero(level)])
    return np.asarray(lines / np.maximum(number - lines[::-1] + both, 1))


def _beside(cells: NDArray[np.int8]) -> NDArray[np.int8]:
    """Largest of the four neighbours of each cell (rows, columns)."""
    padded = np.pad(cells, 1, constant_values=-1)
    sides = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    return np.asarray(np.maximum.reduce(sides))


def possible(submap: Submap, points: Array, pose: Array, score: float, best: float) -> float:
    """The score at a pose if end points where nothing is mapped fitted as at the best place.

    A map in the making has one half of a symmetric hall before the other: that the known half
    fits better says nothing.
    """
    return may_be(score, unmapped_share(submap, points, pose), best)


def may_be(score: float, unmapped: float, best: float) -> float:
    """A score, where the ``unmapped`` share of the end points fitted as well as ``best``."""
    return score + unmapped * max(best - UNKNOWN, 0.0)


def unmapped_share(submap: Submap, points: Array, pose: Array) -> float:
    """Share of the end points (n, 2) that are where nothing is mapped, and not behind a wall."""
    ends = se2.transform(pose, points)
    reach = float(np.hypot(points[:, 0], points[:, 1]).max())
    share = np.linspace(0.0, 1.0, min(max(2, int(reach / submap.resolution)), MAX_STEPS))[:, None]
    free = _values(submap, ends) == 0
    for k in np.flatnonzero(free).tolist():
        # the laser is near enough to the base for this
        way = pose[:2] + share * (ends[k] - pose[:2])
        free[k] = not (_values(submap, way) > value_of(WALL)).any()
    return float(np.mean(free))


def _values(submap: Submap, points: Array) -> NDArray[np.uint16]:
    """Cell values (...) at points (..., 2), 0 outside."""
    (j, i), (rows, columns) = submap.corner, submap.values.shape
    cells = np.floor(points / submap.resolution).astype(np.int64) - (j, i)
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=-1)
    out = np.zeros(points.shape[:-1], dtype=np.uint16)
    out[inside] = submap.values[cells[inside][:, 1], cells[inside][:, 0]]
    return out
