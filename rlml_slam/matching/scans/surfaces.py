# SPDX-License-Identifier: Apache-2.0
"""Surface that an end point lies on, estimated from its neighbours in the scan.

A laser samples a wall at points; a grid that holds only these points has a texture along the
wall that the wall does not have, and a match sticks to it. So gaps between neighbours on one
surface are filled before a scan enters a submap, and a match uses the slope of the submap across
a surface only, never along it. End points are in scan order.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import brief
from rlml_slam.se2 import Array

MAX_GAP = 0.6  # [m] wider gaps between neighbours are not filled
BEND = 0.1  # slope of the next neighbour off the line, up to which it is one surface
ROUGHNESS = 0.03  # [m] scatter of end points across a surface
REACH = 3  # neighbours on each side from which the surface is estimated
WIDE = 9  # neighbours on each side where the former are too close together for it
MAX_STEP = 1.0  # [m] neighbours farther apart are not of one surface
FLAT = 0.02  # variance across per variance along, below which neighbours are a line


@brief
def fill(points: Array, spacing: float) -> Array:
    """End points (m, 2) with the gaps of straight surfaces filled, in scan order.

    ``points`` (n, 2) in scan order. A gap of more than ``spacing`` between two neighbours is
    filled with points between them if the neighbours beyond lie on the same line.
    """
    n = len(points)
    counts = np.zeros(n, dtype=np.int64)
    total = n
    for k in range(1, n - 2):
        ex, ey = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        length = np.hypot(ex, ey)
        if not spacing < length <= MAX_GAP:
            continue
        nx, ny = -ey / length, ex / length
        ax, ay = points[k - 1, 0] - points[k, 0], points[k - 1, 1] - points[k, 1]
        bx, by = points[k + 2, 0] - points[k + 1, 0], points[k + 2, 1] - points[k + 1, 1]
        before, after = np.hypot(ax, ay), np.hypot(bx, by)
        if (
            max(before, after) <= 2.0 * MAX_GAP
            and abs(ax * nx + ay * ny) <= ROUGHNESS + BEND * before
            and abs(bx * nx + by * ny) <= ROUGHNESS + BEND * after
        ):
            counts[k] = int(np.ceil(length / spacing))
            total += counts[k]
    out = np.empty((total, 2))
    m = 0
    for k in range(n):
        out[m, 0], out[m, 1] = points[k, 0], points[k, 1]
        m += 1
        parts = counts[k] + 1
        for q in range(1, parts):
            f = q / parts
            out[m, 0] = points[k, 0] + f * (points[k + 1, 0] - points[k, 0])
            out[m, 1] = points[k, 1] + f * (points[k + 1, 1] - points[k, 1])
            m += 1
    return out


@brief
def constraints(points: Array) -> Array:
    """Per end point (n, 3) the matrix [[a, b], [b, c]] as (a, b, c) that its slope goes through.

    ``points`` (n, 2) in scan order, base frame. On a surface with unit normal u it is u u^T, in
    clutter the identity, and 0 for a point with too few neighbours to distinguish a post from a
    wall at a grazing angle.
    """
    n = len(points)
    out = np.zeros((n, 3))
    joined = np.zeros(n, dtype=np.bool_)  # with the next one
    for k in range(n - 1):
        dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        joined[k] = dx * dx + dy * dy < MAX_STEP * MAX_STEP
    for k in range(n):
        first = last = k
        for reach in (REACH, WIDE):
            while first > 0 and k - first < reach and joined[first - 1]:
                first -= 1
            while last < n - 1 and last - k < reach and joined[last]:
                last += 1
            m = last - first + 1
            sx = sy = sxx = sxy = syy = 0.0
            for q in range(first, last + 1):
                x, y = points[q, 0] - points[k, 0], points[q, 1] - points[k, 1]
                sx += x
                sy += y
                sxx += x * x
                sxy += x * y
                syy += y * y
            sxx, sxy, syy = (
                (sxx - sx * sx / m) / m, (sxy - sx * sy / m) / m, (syy - sy * sy / m) / m
            )  # fmt: skip
            mean, half = 0.5 * (sxx + syy), 0.5 * (sxx - syy)
            root = np.sqrt(half * half + sxy * sxy)
            across, along = mean - root, mean + root
            # close together, points on a wall scatter across it as much as along
            if across >= ROUGHNESS * ROUGHNESS or across < FLAT * along:
                break
        if m < 4:
            continue
        if across < ROUGHNESS * ROUGHNESS and across < FLAT * along:
            # the normal's outer product, from the double angle of the surface
            c, s = half / root, sxy / root
            out[k, 0], out[k, 1], out[k, 2] = 0.5 * (1.0 - c), -0.5 * s, 0.5 * (1.0 + c)
        else:
            out[k, 0], out[k, 2] = 1.0, 1.0
    return out


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    points = np.array([[1.0, 0.1 * k] for k in range(6)])
    fill(points, 0.05)
    constraints(points)
