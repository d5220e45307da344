# SPDX-License-Identifier: Apache-2.0
"""Thinning of end points: one per voxel, at most max_points; deterministic.

Which points are kept does not depend on the way round that a laser measures: with the first of
each voxel, a robot that drives along corridors slowly turns in its map, always to the same side.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import brief
from rlml_slam.se2 import Array

TILT = math.sqrt(2.0)  # so that no wall at right angles to the robot has points that are equal


def thin(points: Array, voxel: float, max_points: int) -> Array:
    """The points ``(n, 2)`` kept, in their order: the middle of each voxel, then evenly chosen.

    ``voxel`` [m], 0 keeps all; of the two in the middle of an even number, the one with the
    smaller |x| + 1.4 |y| is kept. Of more than ``max_points`` that remain, every
    (n / max_points)-th is kept. Points that are not finite are dropped. Points in reverse order
    give the same points in reverse order, but for the middle one of an odd number out of an even.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    return thin_points(points, voxel, max_points)


@brief
def thin_points(points: Array, voxel: float, max_points: int) -> Array:
    """Kernel of thin(): voxel indices go through an open-addressing hash table."""
    n = len(points)
    size = 16
    while size < 2 * n:
        size *= 2
    table_j = np.empty(size, dtype=np.int64)
    table_i = np.empty(size, dtype=np.int64)
    counts, passed = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
    lower = np.empty(size, dtype=np.int64)  # of the two in the middle
    slots = np.full(n, -1, dtype=np.int64)
    scale = 1.0 / voxel if voxel > 0.0 else 0.0
    for k in range(n):
        x, y = points[k, 0], points[k, 1]
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        slot = k
        if voxel > 0.0:
            j, i = int(np.floor(x * scale)), int(np.floor(y * scale))
            slot = (j * 73856093 ^ i * 19349663) & (size - 1)
            while counts[slot] and not (table_j[slot] == j and table_i[slot] == i):
                slot = (slot + 1) & (size - 1)
            table_j[slot], table_i[slot] = j, i
        slots[k] = slot
        counts[slot] += 1
    kept = np.zeros(n, dtype=np.bool_)
    count = 0
    for k in range(n):
        slot = slots[k]
        if slot < 0:
            continue
        if passed[slot] == (counts[slot] - 1) // 2:
            kept[k], lower[slot] = True, k
            count += 1
        elif passed[slot] == counts[slot] // 2:
            q = lower[slot]
            x, y = abs(points[k, 0]) - abs(points[q, 0]), abs(points[k, 1]) - abs(points[q, 1])
            if x + TILT * y < 0.0:
                kept[k], kept[q] = True, False
        passed[slot] += 1
    m = min(count, max_points)
    out = np.empty((m, 2))
    taken = number = 0
    for k in range(n):
        if taken == m:
            break
        if not kept[k]:
            continue
        from_end = min(taken, m - 1 - taken)  # the middles of m equal parts, alike from both ends
        middle = (2 * from_end + 1) * count // (2 * m)
        if number == (middle if from_end == taken else count - 1 - middle):
            out[taken, 0], out[taken, 1] = points[k, 0], points[k, 1]
            taken += 1
        number += 1
    return out


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    thin(np.zeros((3, 2)), 0.05, 2)
