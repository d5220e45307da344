# SPDX-License-Identifier: Apache-2.0
"""The site of a layout: what stops beams, where reflectors are, where the robot can be."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from rlml_slam.maps.nav2_map import FREE_THRESH
from rlml_slam.maps.occupancy import UNKNOWN, OccupancyGrid
from rlml_slam.maps.survey import Survey
from rlml_slam.se2 import Array, between, transform
from rlml_slam.simulation.world import Geometry, ReflectorSet, World
from rlml_slam.types import ANONYMOUS, Reflectors

RESOLUTION = 0.05  # [m] of the grid of a world
OCCUPIED = 65  # as nav2 has it
CARVED = 0.15  # [m] around a reflector, the grid's cells are the reflector itself
DIAMETER = 0.08  # [m] of a reflector where it is not known
WALLS = np.array([0.6, 0.0, 0.0, -1.0])  # surface of what a grid has


@dataclass(frozen=True)
class Site:
    """``walls`` stop beams; ``grid`` has them as cells, and is ``free`` where the robot can be.

    ``cov`` (m, 2, 2) are the covariances of the reflectors in the map. ``oriented``: it is known
    which reflectors are flat, and their normals.
    """

    walls: Geometry
    reflectors: ReflectorSet
    cov: Array
    grid: OccupancyGrid
    oriented: bool = True

    @property
    def free(self) -> NDArray[np.bool_]:
        """Cells that are free: by the probability below which nav2 takes them as free."""
        cells = self.grid.cells
        return (cells >= 0) & (cells <= 100 * FREE_THRESH)

    def with_reflectors(self, survey: Survey) -> Site:
        """The same site with the reflectors of a survey, which is in the frame of the map."""
        n = len(survey.points)
        ids = np.where(survey.ids == ANONYMOUS, np.arange(n), survey.ids)
        found = cylinders(survey.points, ids, survey.diameters)
        return replace(self, reflectors=found, cov=np.zeros((n, 2, 2)), oriented=False)

    def with_posts(self, points: Array) -> Site:
        """The same site with cylinders (k, 2) added; they do not hide places."""
        r, k = self.reflectors, len(points)
        posts = cylinders(points, int(r.ids.max(initial=0)) + 1 + np.arange(k))
        pairs = zip(vars(r).values(), vars(posts).values(), strict=True)
        both = ReflectorSet(*(np.concatenate(pair) for pair in pairs))
        return replace(self, reflectors=both, cov=np.concatenate([self.cov, np.zeros((k, 2, 2))]))


def cylinders(
    points: Array, ids: NDArray[np.int64], diameters: ArrayLike = DIAMETER
) -> ReflectorSet:
    """Reflectors at ``points`` (k, 2) that are seen from all sides; NaN: diameter not known."""
    unknown = np.full(len(points), np.nan)
    widths = np.where(np.isfinite(diameters), diameters, np.full(len(points), DIAMETER))
    return ReflectorSet(points, widths, unknown, ids)


def of_world(world: World) -> Site:
    """The site of a world without what moves; free is what can be reached from its start."""
    lines, r = world.static.segments, world.reflectors.points
    ends = np.concatenate([lines[:, :2], lines[:, 2:4], r, world.route, world.start[None, :2]])
    low = np.floor(ends.min(axis=0)) - 1.0
    columns, rows = np.ceil((ends.max(axis=0) + 1.0 - low) / RESOLUTION).astype(int)
    wall = np.zeros((rows, columns), dtype=np.bool_)
    for x0, y0, x1, y1 in world.static.segments[:, :4]:
        share = np.linspace(0.0, 1.0, 2 + int(math.hypot(x1 - x0, y1 - y0) / (0.4 * RESOLUTION)))
        _mark(wall, np.stack([x0 + share * (x1 - x0), y0 + share * (y1 - y0)], -1), low)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    for x, y, radius in world.static.discs[:, :3]:
        _mark(wall, np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], -1), low)
    label, _ = ndimage.label(~wall)
    j, i = np.floor((world.start[:2] - low) / RESOLUTION).astype(int)
    cells = np.where(wall, 100, np.where(label == label[i, j], 0, UNKNOWN)).astype(np.int8)
    grid = OccupancyGrid(RESOLUTION, (float(low[0]), float(low[1])), cells)
    return Site(world.static, world.reflectors, np.zeros((len(world.reflectors), 2, 2)), grid)


def _mark(cells: NDArray[np.bool_], points: Array, low: Array) -> None:
    j, i = np.floor((points - low) / RESOLUTION).astype(int).T
    cells[i, j] = True


def of_grid(grid: OccupancyGrid, found: Reflectors) -> Site:
    """The site of a saved map; cells near a reflector do not hide it."""
    reflectors = cylinders(found.points, found.keys, found.diameters)
    site = Site(Geometry(np.zeros((0, 6)), np.zeros((0, 5)), np.zeros((0, 4))), reflectors,
                found.cov, grid, oriented=False)  # fmt: skip
    return with_walls_of_grid(site)


def with_walls_of_grid(site: Site) -> Site:
    """The outlines of the occupied cells as walls, but for those of the reflectors."""
    grid, points = site.grid, site.reflectors.points
    wall = grid.cells >= OCCUPIED
    i, j = np.nonzero(wall)
    if len(points) and len(i):
        centres = transform(grid.T_map_grid, grid.resolution * (np.stack([j, i], -1) + 0.5))
        near = cKDTree(points).query(centres)[0] < CARVED
        wall[i[near], j[near]] = False
    across = _edges(wall)
    lines = np.concatenate([across, _edges(wall.T)[:, [1, 0, 3, 2]]]) * grid.resolution
    ends = [transform(grid.T_map_grid, lines[:, k : k + 2]) for k in (0, 2)]
    segments = np.concatenate([*ends, np.zeros((len(lines), 2))], -1)
    surface = np.tile(WALLS, (len(lines), 1))
    return replace(site, walls=Geometry(segments, np.zeros((0, 5)), surface))


def _edges(wall: NDArray[np.bool_]) -> Array:
    """Segments (s, 4) in cells along the rows, between a cell that is wall and one that is not."""
    edge = np.diff(np.pad(wall, ((1, 1), (0, 0))).astype(np.int8), axis=0) != 0
    runs = np.diff(np.pad(edge, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, first = np.nonzero(runs == 1)
    _, end = np.nonzero(runs == -1)
    return np.stack([first, row, end, row], -1).astype(np.float64)


def known(site: Site) -> Reflectors:
    """Its reflectors as those of a saved map, anonymous ones."""
    r, n = site.reflectors, len(site.reflectors)
    anonymous = np.full(n, ANONYMOUS, dtype=np.int64)
    return Reflectors(r.ids, r.points, site.cov, anonymous, np.zeros(n, np.int64), r.widths)


def places(site: Site, spacing: float, clearance: float) -> Array:
    """Places (n, 2) about every ``spacing`` [m], free and ``clearance`` [m] from what is not."""
    grid = site.grid
    step = max(1, round(spacing / grid.resolution))
    room = ndimage.distance_transform_edt(site.free) * grid.resolution
    i, j = np.nonzero(room[step // 2 :: step, step // 2 :: step] > clearance)
    cells = np.stack([j, i], -1) * step + step // 2 + 0.5
    return transform(grid.T_map_grid, grid.resolution * cells)


def inside(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (n, 2) are inside a polygon (k, 2): an odd number of sides is right of them."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    right = x < a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
    odd: NDArray[np.bool_] = (crosses & right).sum(axis=1) % 2 == 1
    return odd


def on_path(poses: Array, spacing: float) -> Array:
    """Those of the poses (n, 3) that are ``spacing`` [m] of travel apart."""
    step = np.hypot(*between(poses[:-1], poses[1:])[:, :2].T)
    lap = np.floor(np.concatenate([[0.0], np.cumsum(step)]) / spacing)
    return poses[np.unique(lap, return_index=True)[1]]
