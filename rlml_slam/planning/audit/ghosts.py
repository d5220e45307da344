# SPDX-License-Identifier: Apache-2.0
"""Detections where the layout has no reflector: where from, and through which wall mirrored.

A mirror image g of a reflector m stands behind its mirror, which is on the perpendicular bisector
of g and m. Lines of sight from the laser to g cross the bisector where the mirror is: at a wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.planning.audit.evidence import Evidence
from rlml_slam.planning.site import OCCUPIED
from rlml_slam.se2 import Array

NEAR = 0.25  # [m] between detections of one ghost
LEAST, SPELLS = 8, 2  # detections of a ghost, and meters of travel with some of them
AT_WALL, WALL_SHARE = 0.15, 0.85  # [m] from a wall, and the share of crossings that must be so
APART = 0.4  # [m] between a mirror image and its reflector, at least


@dataclass(frozen=True)
class Ghost:
    """``place`` (2,) of ``count`` detections in ``scans`` (q,), rows of the scans.

    A mirror image of reflector ``mirrored`` (-1: none found) in the wall from ``wall[0]`` to
    ``wall[1]``, as far as it was crossed.
    """

    place: Array
    count: int
    scans: Array
    mirrored: int
    wall: Array


def ghosts(e: Evidence) -> list[Ghost]:
    """Ghosts that were seen again and again at one place, the most frequent first."""
    rows = np.flatnonzero(e.match < 0)
    if not len(rows):
        return []
    pairs = cKDTree(e.points[rows]).query_pairs(NEAR, output_type='ndarray')
    shape = (len(rows), len(rows))
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
    count, label = connected_components(graph, directed=False)
    away = _distance_to_walls(e)
    found = []
    for k in range(count):
        mine = rows[label == k]
        scans = np.unique(e.sightings.scan[mine])
        if len(scans) < LEAST or len(np.unique(e.block[scans])) < SPELLS:
            continue
        place = np.median(e.points[mine], axis=0)
        mirrored, wall = _mirror(e, place, scans, away)
        found.append(Ghost(place, len(mine), scans, mirrored, wall))
    return sorted(found, key=lambda g: -g.count)


def _distance_to_walls(e: Evidence) -> Array:
    """[m] of each cell of the grid to the nearest occupied one."""
    grid = e.site.grid
    wall = grid.cells >= OCCUPIED
    if not wall.any():
        return np.full(grid.cells.shape, np.inf)
    out: Array = ndimage.distance_transform_edt(~wall) * grid.resolution
    return out


def _mirror(e: Evidence, ghost: Array, scans: Array, away: Array) -> tuple[int, Array]:
    """The reflector whose mirror image it is, -1 for none, and the ends (2, 2) of the mirror."""
    grid, lasers = e.site.grid, e.sightings.lasers[scans]
    best, least, wall = -1, AT_WALL, np.full((2, 2), np.nan)
    for k, m in enumerate(e.site.reflectors.points):
        u = ghost - m
        if np.hypot(*u) < APART:
            continue
        sight = ghost - lasers
        with np.errstate(divide='ignore', invalid='ignore'):
            t = ((0.5 * (ghost + m) - lasers) @ u) / (sight @ u)
        between = (t > 0.0) & (t < 1.0)
        if between.mean() < WALL_SHARE:
            continue
        crossed = lasers[between] + t[between, None] * sight[between]
        j, i = np.floor(
            se2.transform(se2.inverse(grid.T_map_grid), crossed) / grid.resolution
        ).astype(int).T  # fmt: skip
        inside = (i >= 0) & (j >= 0) & (i < away.shape[0]) & (j < away.shape[1])
        gap = np.where(inside, away[np.where(inside, i, 0), np.where(inside, j, 0)], np.inf)
        mean = float(np.sqrt(np.mean(np.minimum(gap, 1.0) ** 2)))
        if np.mean(gap < AT_WALL) * between.mean() >= WALL_SHARE and mean < least:
            along = crossed @ np.array([-u[1], u[0]])
            best, least, wall = k, mean, crossed[[along.argmin(), along.argmax()]]
    return best, wall
