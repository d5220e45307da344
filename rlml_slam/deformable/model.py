# SPDX-License-Identifier: Apache-2.0
"""Motion and measurement models with their Jacobians, restated from the note.

Written as kernels on scalars and small arrays, so that the EKF, the smoother and the planner share
them. Corrections of the note: the odometry Jacobian is R J v; the feature model is
R(theta_i)^T (f - p) at the same step i; the smooth model is f_{i+1} - f_i.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.se2 import Array

Indices = NDArray[np.int64]


class Noise(NamedTuple):
    """Noise that every estimator knows."""

    heading: float = 0.01  # sigma of one step's turn [rad]
    position: float = 0.02  # sigma of one step's travel, per axis [m]
    drift2: float = 0.3**2 + 0.2**2  # variance of a feature's own motion per step and axis [m^2]
    edge: float = 0.2  # sigma of a construction measurement, per axis [m]


class Sensor(NamedTuple):
    """Range limits [m] and noise per axis [m], linear in the distance between them."""

    near: float
    far: float
    sigma_near: float
    sigma_far: float


@kernel
def motion(
    x: float, y: float, theta: float, control: Array
) -> tuple[float, float, float, float, float]:
    """Pose after ``control`` (v_x, v_y, omega), and d x / d theta, d y / d theta.

    p_{i+1} = p_i + R(theta_i) v_i, theta_{i+1} = theta_i + omega_i; d p_{i+1} / d theta = R J v.
    The other derivatives are those of the identity.
    """
    c, s = math.cos(theta), math.sin(theta)
    dx = c * control[0] - s * control[1]
    dy = s * control[0] + c * control[1]
    return x + dx, y + dy, theta + control[2], -dy, dx


@kernel
def observe_feature(state: Array, j: int, z: Array, H: Array) -> None:
    """Feature j in the robot's frame: z = R(theta)^T (f_j - p); ``H`` (2, 5) its Jacobian.

    The columns of H are (x, y, theta, f_jx, f_jy): d z / d p = -R^T, d z / d theta = -J z,
    d z / d f = R^T.
    """
    c, s = math.cos(state[2]), math.sin(state[2])
    dx, dy = state[3 + 2 * j] - state[0], state[4 + 2 * j] - state[1]
    z[0] = c * dx + s * dy
    z[1] = -s * dx + c * dy
    H[0, 0], H[0, 1], H[0, 2], H[0, 3], H[0, 4] = -c, -s, z[1], c, s
    H[1, 0], H[1, 1], H[1, 2], H[1, 3], H[1, 4] = s, -c, -z[0], -s, c


@kernel
def sigma_at(distance: float, sensor: Sensor) -> float:
    """Feature noise per axis [m], linear in the distance, constant outside the range limits."""
    share = (distance - sensor.near) / (sensor.far - sensor.near)
    return sensor.sigma_near + min(max(share, 0.0), 1.0) * (sensor.sigma_far - sensor.sigma_near)


@kernel
def in_range_probability(mean_x: float, mean_y: float, S: Array, near: float, far: float) -> float:
    """Probability that near <= |d| <= far for d ~ N(mean, S), S (2, 2).

    |d|^2 is a quadratic form in normals: its cube root is nearly normal (Wilson and Hilferty),
    with the mean and variance of |d|^2 exact.
    """
    square = mean_x * mean_x + mean_y * mean_y
    first = square + S[0, 0] + S[1, 1]
    second = 2.0 * (S[0, 0] ** 2 + 2.0 * S[0, 1] ** 2 + S[1, 1] ** 2) + 4.0 * (
        mean_x * (S[0, 0] * mean_x + S[0, 1] * mean_y)
        + mean_y * (S[0, 1] * mean_x + S[1, 1] * mean_y)
    )
    if second <= 0.0:
        return 1.0 if near * near <= square <= far * far else 0.0
    spread = second / (9.0 * first * first)
    center, scale = 1.0 - spread, math.sqrt(2.0 * spread)
    upper = math.erf(((far * far / first) ** (1.0 / 3.0) - center) / scale)
    lower = math.erf(((near * near / first) ** (1.0 / 3.0) - center) / scale)
    return 0.5 * (upper - lower)
