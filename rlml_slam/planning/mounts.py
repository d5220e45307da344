# SPDX-License-Identifier: Apache-2.0
"""Where a reflector can be mounted: on walls, pillars and poles, and in the way of no robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from rlml_slam.planning.free_ways import leave_path, leave_ways
from rlml_slam.planning.site import DIAMETER, OCCUPIED, Site
from rlml_slam.se2 import Array, transform

APART = 0.5  # [m] between reflectors: nearer ones may be merged
MOST = 400  # mounts that are tried
NO_PATH = np.zeros((0, 2))


def wall_mounts(site: Site, spacing: float, clearance: float, path: Array = NO_PATH) -> Array:
    """Centres (c, 2) of reflectors on walls and pillars about ``spacing`` [m] apart.

    In free cells that one step separates from an occupied one, so that a post touches the wall
    and does not stand in an aisle, and on the side that robots can reach.
    """
    grid = site.grid
    r = grid.resolution
    if not (grid.cells >= OCCUPIED).any():
        return np.zeros((0, 2))
    away = ndimage.distance_transform_edt(grid.cells < OCCUPIED) * r
    least = 0.5 * DIAMETER + 0.75 * r
    i, j = np.nonzero(site.free & (away >= least) & (away < least + r))
    points = transform(grid.T_map_grid, r * (np.stack([j, i], -1) + 0.5))
    kept = thin(points, spacing, site.reflectors.points)
    return out_of_the_way(site, kept, clearance, path)


def out_of_the_way(site: Site, posts: Array, clearance: float, path: Array = NO_PATH) -> Array:
    """Those of the posts (k, 2) that robots, ``clearance`` [m] to each side, can pass."""
    posts = posts[leave_path(path, posts, clearance)]
    return posts[leave_ways(site, posts, clearance)]


def thin(points: Array, spacing: float, present: Array) -> Array:
    """Points (c, 2) at least ``spacing`` apart and APART from ``present`` (m, 2), MOST at most."""
    spacing = max(spacing, APART)
    if len(points) and len(present):
        points = points[cKDTree(present).query(points)[0] >= APART]
    while len(kept := _poisson(points, spacing)) > MOST:
        spacing *= 1.0 + 0.5 * (len(kept) / MOST - 1.0) + 0.05
    return points[kept]


def _poisson(points: Array, spacing: float) -> NDArray[np.int64]:
    """Indices of points of which no two are nearer than ``spacing``, in order."""
    free = np.ones(len(points), dtype=np.bool_)
    kept = []
    if len(points):
        tree = cKDTree(points)
        for k in range(len(points)):
            if free[k]:
                free[tree.query_ball_point(points[k], spacing)] = False
                kept.append(k)
    return np.array(kept, dtype=np.int64)
