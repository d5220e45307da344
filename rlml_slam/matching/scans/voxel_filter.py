# SPDX-License-Identifier: Apache-2.0
"""Thinning of end points: one per voxel, at most max_points; deterministic."""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import brief
from rlml_slam.se2 import Array


def thin(points: Array, voxel: float, max_points: int) -> Array:
    """The points ``(n, 2)`` kept, in their order: the first of each voxel, then evenly chosen.

    ``voxel`` [m], 0 keeps all; where more than ``max_points`` remain, every (n / max_points)-th
    is kept. Points that are not finite are dropped.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    return thin_points(points, voxel, max_points)


@brief
def thin_points(points: Array, voxel: float, max_points: int) -> Array:
    """Kernel of thin(): voxel indices go through an open-addressing hash table."""
    n = len(points)
    kept = np.empty(n, dtype=np.int64)
    count = 0
    size = 16
    while size < 2 * n:
        size *= 2
    table_j = np.empty(size, dtype=np.int64)
    table_i = np.empty(size, dtype=np.int64)
    used = np.zeros(size, dtype=np.bool_)
    scale = 1.0 / voxel if voxel > 0.0 else 0.0
    for k in range(n):
        x, y = points[k, 0], points[k, 1]
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        if voxel > 0.0:
            j, i = int(np.floor(x * scale)), int(np.floor(y * scale))
            slot = (j * 73856093 ^ i * 19349663) & (size - 1)
            while used[slot] and not (table_j[slot] == j and table_i[slot] == i):
                slot = (slot + 1) & (size - 1)
            if used[slot]:
                continue
            used[slot], table_j[slot], table_i[slot] = True, j, i
        kept[count] = k
        count += 1
    m = min(count, max_points)
    out = np.empty((m, 2))
    for k in range(m):
        source = kept[k * count // m]
        out[k, 0], out[k, 1] = points[source, 0], points[source, 1]
    return out


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    thin(np.zeros((3, 2)), 0.05, 2)
