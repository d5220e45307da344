# SPDX-License-Identifier: Apache-2.0
"""Posts that leave the ways of robots free.

A robot passes where its centre is ``clearance`` from all obstacles. A post takes a disc out of
these places. It closes a way if the places around the disc fall into several parts: what was on
both sides of the post is no longer joined beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rlml_slam.planning.site import DIAMETER, Site
from rlml_slam.se2 import Array, inverse, transform

MARGIN = 0.05  # [m] between a post and a robot on the path
CORNER = 2.0**-0.5  # [cells] from the centre of a cell to its farthest point
THIN, WIDE = 1.42, 3.0  # [cells] width of the ring around a disc, and where its parts are joined
SLACK = (1.75, 1.25, 0.75, 0.25, 0.0)  # [cells] a way may be wider than the grid has it
JOINED = np.ones((3, 3))


def leave_ways(site: Site, posts: Array, clearance: float) -> NDArray[np.bool_]:
    """Which of the posts (k, 2) close no way, alone or with others, in the order given."""
    grid, r = site.grid, site.grid.resolution
    # to the nearest point of a cell, not to its centre: never more than it is
    room = ndimage.distance_transform_edt(site.free) * r - CORNER * r
    to_grid = inverse(grid.T_map_grid)
    for point, width in zip(transform(to_grid, site.reflectors.points), site.reflectors.widths,
                            strict=True):  # fmt: skip
        _stand(room, r, point, 0.5 * width, clearance)
    found = np.ones(len(posts), dtype=np.bool_)
    for k, point in enumerate(transform(to_grid, posts)):
        found[k] = not _closes(room, r, point, clearance)
        if found[k]:
            _stand(room, r, point, 0.5 * DIAMETER, clearance)
    return found


def _closes(room: Array, r: float, post: Array, clearance: float) -> bool:
    """Whether a robot, or one that is narrower by the SLACK of the grid, cannot pass any more."""
    window, away = _around(room, r, post, clearance + DIAMETER + WIDE * r)
    for half in (clearance - s * r for s in SLACK):
        beyond = away - half - 0.5 * DIAMETER
        outside = (room[window] >= half) & (beyond > 0.0) & (beyond <= WIDE * r)
        part, _ = ndimage.label(outside, JOINED)
        if len(np.unique(part[outside & (beyond <= THIN * r)])) > 1:
            return True
    return False


def _stand(room: Array, r: float, post: Array, radius: float, clearance: float) -> None:
    """Less room beside a post."""
    window, away = _around(room, r, post, radius + clearance + r)
    room[window] = np.minimum(room[window], away - radius)


def _around(room: Array, r: float, post: Array, reach: float) -> tuple[tuple[slice, slice], Array]:
    """The cells ``reach`` [m] around a post, and the distances of their centres."""
    low = np.maximum(np.floor((post - reach) / r).astype(int), 0)
    high = np.maximum(np.floor((post + reach) / r).astype(int) + 1, 0)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    rows, columns = room[window].shape
    x = (low[0] + np.arange(columns) + 0.5) * r - post[0]
    y = (low[1] + np.arange(rows) + 0.5) * r - post[1]
    return window, np.hypot(x, y[:, None])


def leave_path(path: Array, posts: Array, clearance: float) -> NDArray[np.bool_]:
    """Which of the posts (k, 2) are beside a robot on the path (n, 2), with MARGIN."""
    if not len(path):
        return np.ones(len(posts), dtype=np.bool_)
    start, step = path, np.diff(path, axis=0, append=path[-1:])
    length = np.maximum(np.sum(step**2, axis=1), 1e-12)
    near = [
        np.hypot(*(start + share[:, None] * step - p).T).min()
        for p in posts
        for share in [np.clip(np.sum((p - start) * step, axis=1) / length, 0.0, 1.0)]
    ]
    free: NDArray[np.bool_] = np.array(near) >= clearance + 0.5 * DIAMETER + MARGIN
    return free
