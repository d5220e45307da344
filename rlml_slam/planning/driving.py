# SPDX-License-Identifier: Apache-2.0
"""Sigma of the pose while driving: the steady state of the filter's covariance recursion.

From scan to scan the position gains the variance q of odometry (eq. 9) and each scan adds the
information A of reflectors: 1/p = 1/(p + q) + A in every direction of A, where the prediction
brings 1/(p + q) = 2 / (q (1 + sqrt(1 + 4/(q A)))). Heading is estimated from each scan alone, and
q is that of odometry's worse direction, so the pose of any heading is at least as good. The scan
counts once: the error of a grid is the same in successive scans.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.motion import motion_of
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array


def motion_variance(speed: float, interval: float, noise: MotionNoise) -> float:
    """Variance [m^2] of odometry between scans ``interval`` [s] apart, in the worse direction."""
    motion = motion_of(np.array([speed * interval, 0.0, 0.0]), interval, noise)
    return float(np.linalg.eigvalsh(motion.cov[:2, :2])[-1])


def schur(information: Array) -> tuple[Array, Array, Array]:
    """Information xx, xy, yy of the position with the heading unknown, of rows (..., 6)."""
    xx, xy, xt, yy, yt, tt = np.moveaxis(information, -1, 0)
    inverse = 1.0 / np.maximum(tt, 1e-30)
    return xx - xt * xt * inverse, xy - xt * yt * inverse, yy - yt * yt * inverse


def predicted(information: Array, q: float) -> Array:
    """Information (..., 6) that the prediction brings where scans have (..., 6) of reflectors.

    ``q`` [m^2] is infinite for a single scan, which has no prediction.
    """
    if math.isinf(q):
        return np.zeros_like(information)
    a, b, c = schur(information)
    mean, half = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    low, high = (_of_direction(mean + sign * half, q) for sign in (-1.0, 1.0))
    # the function of a symmetric matrix of two directions: offset I + slope A
    slope = np.where(half > 1e-9 * mean, (high - low) / np.maximum(2.0 * half, 1e-30), 0.0)
    offset = 0.5 * (low + high) - slope * mean
    zero = np.zeros_like(a)
    return np.stack([offset + slope * a, slope * b, zero, offset + slope * c, zero, zero], -1)


def _of_direction(A: Array, q: float) -> Array:
    share = q * np.maximum(A, 0.0)
    with np.errstate(divide='ignore'):
        w: Array = 2.0 / (q * (1.0 + np.sqrt(1.0 + 4.0 / share)))
    return w
