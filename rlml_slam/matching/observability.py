# SPDX-License-Identifier: Apache-2.0
"""What a scan match is worth: the information of its inlier beams as points on surfaces.

The grid's own Hessian cannot be used for this: its texture (holes between beams, noise) holds a
pose along a bare wall, where nothing real does. Here each end point that the submap explains holds
the pose across the surface it lies on, and not along it; the surface comes from its neighbours in
the scan, and the part of the information that their noise alone would make up is taken off again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.matching.scan_match import INLIER, sample
from rlml_slam.matching.submap import Submap
from rlml_slam.params import ScanMatch
from rlml_slam.se2 import Array

REACH = 0.5  # [m] neighbours of one surface
WINDOW = 8  # neighbours on each side that are looked at
FLAT = 0.05  # scatter across per scatter along, below which the neighbours are a line
CLUTTER = 0.25  # weight per axis of an end point that is on no line
OPEN = 0.01  # share of the strongest direction's information below which one is left open
REGULAR = 1e-6  # added to what may be singular


@part
def _accumulate(
    values: NDArray[np.uint16],
    corner_j: float,
    corner_i: float,
    scale: float,
    points: Array,
    pose: Array,
) -> Array:
    """Sum of J^T J over the inliers (3, 3), x, y, theta of the pose in the submap frame."""
    H = np.zeros((3, 3))
    J = np.empty(3)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = len(points)
    for k in range(n):
        px, py = points[k, 0], points[k, 1]
        rx, ry = c * px - s * py, s * px + c * py
        m, _, _ = sample(
            values, (pose[0] + rx) * scale - corner_j, (pose[1] + ry) * scale - corner_i
        )
        if m < INLIER:
            continue
        count = 0
        sx = sy = sxx = sxy = syy = 0.0
        for q in range(np.uint64(max(0, k - WINDOW)), np.uint64(min(n, k + WINDOW + 1))):
            dx, dy = points[q, 0] - px, points[q, 1] - py
            if dx * dx + dy * dy < REACH * REACH:
                count += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
        if count < 5:
            continue  # too lonely to tell a pole from a wall seen at a grazing angle
        sxx -= sx * sx / count
        sxy -= sx * sy / count
        syy -= sy * sy / count
        mean, half = 0.5 * (sxx + syy), 0.5 * (sxx - syy)
        root = math.sqrt(half * half + sxy * sxy)
        along, across = mean + root, mean - root
        flat = across < FLAT * along
        # the normal, by half of the surface's double angle
        cosine = half / root if root > 0.0 else 1.0
        nx = -math.copysign(math.sqrt(max(0.5 * (1.0 - cosine), 0.0)), sxy)
        ny = math.sqrt(max(0.5 * (1.0 + cosine), 0.0))
        noise = max(across, 0.0) / along / (count - 2)  # variance of that angle
        for axis in range(2):
            if axis == 0 and flat:
                ax, ay, weight = c * nx - s * ny, s * nx + c * ny, 1.0
            elif flat:
                # what the noise of the normal makes up along the surface
                ax, ay, weight = -(s * nx + c * ny), c * nx - s * ny, -noise
            else:
                ax, ay, weight = 1.0 - axis, 1.0 * axis, CLUTTER
            J[0], J[1], J[2] = ax, ay, -ax * ry + ay * rx
            for u in range(3):
                for v in range(3):
                    H[u, v] += weight * J[u] * J[v]
    return H


def information(
    submap: Submap, points: Array, pose: Array, params: ScanMatch, alone: Array | None = None
) -> Array:
    """Information (3, 3) of a match of ``points`` (n, 2), in scan order, at ``pose`` (3,).

    Coordinates are those of the pose in the submap frame. ``params.sigma_point`` is the error of
    one end point across its surface, neighbours' correlation included; ``params.floor2`` (3,) the
    variances of what more points do not average out. A direction that the scan leaves open, for
    it has less than OPEN of the information of the strongest one, has information zero.

    Along a corridor, odometry is better than what the beams on a door frame or two say. A robot
    without it has nothing better. Then ``alone`` (3, 3), the information by the curvature of the
    scan term (eq. 11), is believed in such a direction, up to what counts as open.
    """
    j, i = submap.corner
    return _information(
        submap.values, float(j), float(i), 1.0 / submap.resolution,
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(pose, dtype=np.float64),
        params.sigma_point, np.array(params.floor2), np.zeros((3, 3)) if alone is None else alone,
    )  # fmt: skip


@kernel
def _information(
    values: NDArray[np.uint16],
    corner_j: float,
    corner_i: float,
    scale: float,
    points: Array,
    pose: Array,
    sigma_point: float,
    floor2: Array,
    alone: Array,
) -> Array:
    """Kernel of information()."""
    H = _accumulate(values, corner_j, corner_i, scale, points, pose)
    # eigenvalues of metres and radians compare at the scan's own lever
    # what is taken off for noise can exceed what there is: a diagonal may be negative
    lever = max(math.sqrt(max(H[2, 2], 0.0) / max(H[0, 0] + H[1, 1], 1e-9)), 0.1)
    unit = np.array([1.0, 1.0, 1.0 / lever])
    units = np.outer(unit, unit)
    strength, axes = np.linalg.eigh(H * units)
    least = OPEN * max(strength[2], 0.0)
    # what a direction has by the curvature, the two others being estimated with it
    curved = np.linalg.inv(alone * units * sigma_point**2 + REGULAR * np.eye(3))
    for k in range(3):
        by_curve = 1.0 / np.dot(axes[:, k], np.dot(curved, axes[:, k])) - REGULAR
        strength[k] = max(strength[k] - least, min(by_curve, least), 0.0)
    H = np.dot(axes * strength, axes.T.copy()) / units / sigma_point**2
    # (H^-1 + floor)^-1, written so that an open direction stays open
    out = np.linalg.solve(np.eye(3) + H * floor2, H)
    return 0.5 * (out + out.T)


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    information(submap, points, np.zeros(3), ScanMatch())
