# SPDX-License-Identifier: Apache-2.0
"""Correlative search: exhaustive in a small window around a prior."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import brief, kernel
from rlml_slam.matching.scans.branch_and_bound import Candidate
from rlml_slam.matching.scans.ray_carving import Grid
from rlml_slam.matching.scans.submap import LEVELS, P_MAX, P_MIN, Submap
from rlml_slam.se2 import Array, wrap

FARTHEST = 1e15  # [cells] beyond which nothing is in any grid


class Prior(NamedTuple):
    """A pose (3,) that is expected; its offset has unit variance by ``whitening`` (3, 3).

    It has less and less of a say beyond ``robust_scale`` sigmas. Zeros leave the scan alone.
    """

    pose: Array
    whitening: Array
    robust_scale: float


class Lattice(NamedTuple):
    """(2 n + 1)^2 shifts by ``stride`` cells and 2 m + 1 angles by ``step`` [rad] about a pose."""

    n: int
    stride: int
    m: int
    step: float


def window(
    submap: Submap, points: Array, prior: Prior, half_width: float, half_angle: float,
    share: float = 0.05, stride: int = 1,
) -> Candidate:  # fmt: skip
    """The best pose on a lattice around that of the ``prior``, ties to the nearest.

    The objective is the mean of M less prior_loss(): where the scan leaves the pose open
    (along a corridor), the prior determines it.

    ``points`` (n, 2) in the base frame. Shifts are multiples of ``stride`` cells; the angular
    step moves the mean end point by as much.
    """
    spacing = stride * submap.resolution
    n = round(half_width / spacing)
    reach = float(np.mean(np.hypot(points[:, 0], points[:, 1]))) if len(points) else 1.0
    step = min(max(spacing / max(reach, spacing), 0.005 * stride), 0.05 * stride)
    m = math.ceil(half_angle / step)
    step = half_angle / m if m else 0.0
    unit = share * len(points) * LEVELS / (P_MAX - P_MIN)
    x, y, theta, total = search_window(
        submap.grid, points, prior, Lattice(n, stride, m, step), unit
    )
    score = P_MIN + (P_MAX - P_MIN) * total / (LEVELS * max(len(points), 1))
    return Candidate(np.array([x, y, float(wrap(theta))]), score)


@brief
def prior_loss(x: float, y: float, turn: float, whitening: Array, robust_scale: float) -> float:
    """Sum over u = whitening @ (x, y, turn) of v^2 / (1 + v^2), v = u_k / robust_scale."""
    loss = 0.0
    for h in range(3):
        u = (whitening[h, 0] * x + whitening[h, 1] * y + whitening[h, 2] * turn) / robust_scale
        loss += u * u / (1.0 + u * u)
    return loss


@kernel
def search_window(
    grid: Grid, points: Array, prior: Prior, lattice: Lattice, unit: float
) -> tuple[float, float, float, int]:
    """Exhaustive sum of cell values over a lattice.

    ``unit`` is the sum of cell values that a component far from the prior costs.
    """
    values, corner_j, corner_i, scale = grid
    pose, whitening, robust_scale = prior
    n, stride, m, step = lattice
    width, reach = 2 * n + 1, n * stride
    rows, columns = values.shape
    flat = values.reshape(-1)
    sums = np.empty((width, width), dtype=np.int64)
    offsets = np.empty(len(points), dtype=np.int64)
    best, best_distance = -np.inf, 0.0
    best_a = best_j = best_i = best_sum = 0
    for a in range(-m, m + 1):
        c, s = np.cos(pose[2] + a * step), np.sin(pose[2] + a * step)
        sums[:] = 0
        inside = 0
        for k in range(len(points)):
            px, py = points[k, 0], points[k, 1]
            u = (pose[0] + c * px - s * py) * scale - corner_j
            v = (pose[1] + s * px + c * py) * scale - corner_i
            # numbers that no integer holds, and NaN, are in no grid
            left, low = np.floor(u) - reach, np.floor(v) - reach
            if left >= 0 and low >= 0 and left + 2 * reach < columns and low + 2 * reach < rows:
                offsets[inside] = int(low) * columns + int(left)
                inside += 1
            elif abs(left) < FARTHEST and abs(low) < FARTHEST:
                add_block(values, int(left), int(low), stride, sums)
        for r in range(width):
            for q in range(width):
                shift = (r * columns + q) * stride
                total = 0
                for k in range(inside):
                    total += flat[np.uint64(offsets[k] + shift)]
                sums[r, q] += total
        for r in range(width):
            for q in range(width):
                di, dj = (r - n) * stride, (q - n) * stride
                distance = di * di + dj * dj + a * a
                loss = prior_loss(dj / scale, di / scale, a * step, whitening, robust_scale)
                value = sums[r, q] - unit * loss
                if value > best or (value == best and distance < best_distance):
                    best, best_distance, best_sum = value, distance, sums[r, q]
                    best_a, best_j, best_i = a, dj, di
    return pose[0] + best_j / scale, pose[1] + best_i / scale, pose[2] + best_a * step, best_sum


@kernel
def add_block(
    values: NDArray[np.uint16], j: int, i: int, stride: int, sums: NDArray[np.int64]
) -> None:
    """Add the cells (i, j), (i, j + stride) ... of a square to ``sums``; 0 outside the grid."""
    rows, columns = values.shape
    width = len(sums)
    for r in range(width):
        y = i + r * stride
        if 0 <= y < rows:
            for q in range(width):
                x = j + q * stride
                if 0 <= x < columns:
                    sums[r, q] += values[y, x]


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    window(submap, points, Prior(np.zeros(3), np.zeros((3, 3)), 3.0), 0.1, 0.1)
