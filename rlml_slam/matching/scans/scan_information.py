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
from rlml_slam.matching.scans.ray_carving import Grid
from rlml_slam.matching.scans.scan_match import INLIER, downward, sample, sample_curved
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.matching.scans.surfaces import MAX_STEP
from rlml_slam.params import ScanMatch
from rlml_slam.se2 import Array

REACH = 0.5  # [m] neighbours of one surface
WINDOW = 8  # neighbours on each side that are looked at
FEW = 3  # neighbours on each side where they are farther apart, as a match takes them
FLAT = 0.05  # scatter across per scatter along, below which the neighbours are a line
CLUTTER = 0.25  # weight per axis of an end point that is on no line
OPEN = 0.01  # share of the strongest direction's information below which one is left open
ROUND = 0.5  # curvature of the submap along per across, from which it holds an end point along
SURE = 3.0  # [sigma] by which a weak direction has to be held by more than noise


@part
def _accumulate(grid: Grid, points: Array, pose: Array, sparse: bool) -> tuple[Array, float]:
    """Sum of J^T J over the inliers (3, 3), x, y, theta of the pose in the submap frame.

    Then by how much (one sigma) the noise of the normals may leave more in a direction that is
    along all surfaces than was taken off for it. ``sparse``: whether far surfaces
    that only a few beams hit count too.
    """
    values, corner_j, corner_i, scale = grid
    H, unsure = np.zeros((3, 3)), 0.0
    J = np.empty(3)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = len(points)
    place, fits, usable = np.empty((n, 2)), np.empty(n, np.bool_), np.empty(n, np.bool_)
    for k in range(n):
        px, py = points[k, 0], points[k, 1]
        place[k, 0] = (pose[0] + c * px - s * py) * scale - corner_j
        place[k, 1] = (pose[1] + s * px + c * py) * scale - corner_i
        fits[k] = sample(values, place[k, 0], place[k, 1])[0] >= INLIER
        # beside a post that is not in the submap, a wall point would seem to hold the pose along
        usable[k] = fits[k] or not sparse
    for k in range(n):
        if not fits[k]:
            continue
        px, py = points[k, 0], points[k, 1]
        rx, ry = c * px - s * py, s * px + c * py
        column, row = place[k, 0], place[k, 1]
        first, last = max(0, k - WINDOW), min(n, k + WINDOW + 1)
        count, sxx, sxy, syy = _scatter(points, usable, k, first, last, REACH)
        least = 5
        if count < 5 and sparse:
            least = 4
            first = last = k
            while first > max(0, k - FEW) and _joined(points, first - 1):
                first -= 1
            while last < min(n - 1, k + FEW) and _joined(points, last):
                last += 1
            count, sxx, sxy, syy = _scatter(points, usable, k, first, last + 1, np.inf)
        if count < least:
            continue  # too few neighbours to distinguish a pole from a wall at a grazing angle
        mean, half = 0.5 * (sxx + syy), 0.5 * (sxx - syy)
        root = math.sqrt(half * half + sxy * sxy)
        along, across = mean + root, mean - root
        flat = across < FLAT * along
        # the normal, by half of the surface's double angle
        cosine = half / root if root > 0.0 else 1.0
        nx = -math.copysign(math.sqrt(max(0.5 * (1.0 - cosine), 0.0)), sxy)
        ny = math.sqrt(max(0.5 * (1.0 + cosine), 0.0))
        noise = max(across, 0.0) / along / (count - 2)  # variance of that angle
        unsure += noise * noise if flat else 0.0
        is_round, ux, uy = True, 1.0, 0.0
        if sparse and not flat:
            # as a match has it: across a wall of the submap, whatever stands before it
            is_round, ux, uy = _grip(values, column, row)
        for axis in range(2):
            if axis == 0 and flat:
                ax, ay, weight = c * nx - s * ny, s * nx + c * ny, 1.0
            elif flat:
                # what the noise of the normal makes up along the surface
                ax, ay, weight = -(s * nx + c * ny), c * nx - s * ny, -noise
            elif sparse and not is_round:
                ax, ay, weight = ux, uy, CLUTTER * (1 - axis)
            else:
                ax, ay, weight = 1.0 - axis, 1.0 * axis, CLUTTER
            J[0], J[1], J[2] = ax, ay, -ax * ry + ay * rx
            for u in range(3):
                for v in range(3):
                    H[u, v] += weight * J[u] * J[v]
    # neighbours have their neighbours in common; the square of a normal one has the variance 2
    return H, math.sqrt(2.0 * (2 * WINDOW + 1) * unsure)


@part
def _scatter(
    points: Array, usable: NDArray[np.bool_], k: int, first: int, end: int, reach: float
) -> tuple[int, float, float, float]:
    """Number of usable points of [first, end) within ``reach`` of point k, and their scatter."""
    px, py, count = points[k, 0], points[k, 1], 0
    sx = sy = sxx = sxy = syy = 0.0
    for q in range(np.uint64(first), np.uint64(end)):
        dx, dy = points[q, 0] - px, points[q, 1] - py
        if usable[q] and dx * dx + dy * dy < reach * reach:
            count += 1
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
    count1 = max(count, 1)
    return count, sxx - sx * sx / count1, sxy - sx * sy / count1, syy - sy * sy / count1


@part
def _grip(values: NDArray[np.uint16], column: float, row: float) -> tuple[bool, float, float]:
    """Whether the submap holds an end point in all directions, and in which (2,) most of all."""
    m, m_u, m_v, m_uu, m_uv, m_vv = sample_curved(values, column, row)
    a, b, d = downward(m_uu, m_uv, m_vv)
    e = 1.0 - m
    a, b, d = m_u * m_u + e * a, m_u * m_v + e * b, m_v * m_v + e * d
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    root = math.sqrt(half * half + b * b)
    turn = 0.5 * math.atan2(b, half)
    return mean - root > ROUND * (mean + root), math.cos(turn), math.sin(turn)


@part
def _joined(points: Array, k: int) -> bool:
    """Whether a point and the next one may be of one surface, as a match has it."""
    dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
    return bool(dx * dx + dy * dy < MAX_STEP * MAX_STEP)


def information(
    submap: Submap, points: Array, pose: Array, params: ScanMatch, alone: bool = False
) -> Array:
    """Information (3, 3) of a match of ``points`` (n, 2), in scan order, at ``pose`` (3,).

    Coordinates are those of the pose in the submap frame. ``params.sigma_point`` is the error of
    one end point across its surface, neighbours' correlation included; ``params.variance_floor``
    (3,) the variances of what more points do not average out. A direction that the scan leaves
    open, for it has less than OPEN of the information of the strongest one, has information
    zero.

    Along a corridor, odometry is better than what the beams on a door frame or two say. A robot
    that is ``alone`` with its scans has nothing better. Then they are believed, and so are the few
    on a wall far away, if it is more than the noise of all normals may make up, up to what counts
    as open. The curvature of the scan term (eq. 11) is not: the grid's texture is in it.
    """
    return _information(
        submap.grid, np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(pose, dtype=np.float64),
        params.sigma_point, np.array(params.variance_floor), alone,
    )  # fmt: skip


@kernel
def _information(
    grid: Grid, points: Array, pose: Array, sigma_point: float, floor2: Array, alone: bool
) -> Array:
    """Kernel of information()."""
    H, unsure = _accumulate(grid, points, pose, alone)
    # eigenvalues of metres and radians compare at the scan's own lever
    # what is taken off for noise can exceed what there is: a diagonal may be negative
    lever = max(math.sqrt(max(H[2, 2], 0.0) / max(H[0, 0] + H[1, 1], 1e-9)), 0.1)
    unit = np.array([1.0, 1.0, 1.0 / lever])
    units = np.outer(unit, unit)
    strength, axes = np.linalg.eigh(H * units)
    least = OPEN * max(strength[2], 0.0)
    for k in range(3):
        sure = min(strength[k] - SURE * unsure, least) if alone else 0.0
        strength[k] = max(strength[k] - least, sure, 0.0)
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
