# SPDX-License-Identifier: Apache-2.0
"""Detections of a sensor become detections in the base frame, with sigmas that can be true."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import brief
from rlml_slam.se2 import Array
from rlml_slam.types import Detections

SIGMA = (1e-4, 10.0)  # [m] a detection that claims to be better or worse is believed this much
NEAREST = 0.01  # [m] nearer detections are invalid: drivers report a missing one at the origin


def placed(d: Detections, frame_id: str, T: Array, max_range: float) -> tuple[Detections, bool]:
    """Those within range of a sensor at ``T`` (3,), seen from the frame it sits in.

    That is from NEAREST to ``max_range`` [m]. And whether the sigmas of one had to be bounded.
    """
    there = within(np.ascontiguousarray(d.points, dtype=np.float64), max_range)
    if not there.all():
        d = Detections(
            d.stamp, d.frame_id, d.points[there], d.cov[there], d.ids[there], d.diameters[there]
        )
    cov, bounded = believable(np.ascontiguousarray(d.cov, dtype=np.float64))
    points, cov = se2.transform(T, d.points), turned(cov, float(T[2]))
    return Detections(d.stamp, frame_id, points, cov, d.ids, d.diameters), bounded


@brief
def within(points: Array, reach: float) -> NDArray[np.bool_]:
    """Whether each of the points (k, 2) is from NEAREST to ``reach`` from the origin."""
    out = np.empty(len(points), dtype=np.bool_)
    for k in range(len(points)):
        out[k] = NEAREST <= math.hypot(points[k, 0], points[k, 1]) <= reach
    return out


@brief
def turned(cov: Array, angle: float) -> Array:
    """Covariances (k, 2, 2) of a frame turned by ``angle``, in its parent's axes."""
    c, s = math.cos(angle), math.sin(angle)
    out = np.empty((len(cov), 2, 2))
    for k in range(len(cov)):
        a, b, e, d = cov[k, 0, 0], cov[k, 0, 1], cov[k, 1, 0], cov[k, 1, 1]
        # R C, then R C R^T
        xa, xb, ya, yb = c * a - s * e, c * b - s * d, s * a + c * e, s * b + c * d
        out[k, 0, 0], out[k, 0, 1] = xa * c - xb * s, xa * s + xb * c
        out[k, 1, 0], out[k, 1, 1] = ya * c - yb * s, ya * s + yb * c
    return out


def believable(cov: Array) -> tuple[Array, bool]:
    """Covariances (k, 2, 2) with every sigma inside SIGMA, and whether one had to be bounded.

    A driver that fills in 0 or the largest float for "unknown" must not make the state singular.
    """
    least, most = SIGMA[0] ** 2, SIGMA[1] ** 2
    if _are_between(cov, least, most):
        return cov, False
    values, axes = np.linalg.eigh(0.5 * (cov + np.swapaxes(cov, 1, 2)))
    bounded = np.clip(values, least, most)
    return (axes * bounded[:, None, :]) @ np.swapaxes(axes, 1, 2), True


@brief
def _are_between(cov: Array, least: float, most: float) -> bool:
    """Whether all eigenvalues of the covariances (k, 2, 2) are between two variances."""
    for k in range(len(cov)):
        mean = 0.5 * (cov[k, 0, 0] + cov[k, 1, 1])
        across = 0.5 * (cov[k, 0, 1] + cov[k, 1, 0])
        spread = math.hypot(0.5 * (cov[k, 0, 0] - cov[k, 1, 1]), across)
        if not (mean - spread >= least and mean + spread <= most):
            return False
    return True


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    one = np.zeros(1, dtype=np.int64)
    d = Detections(0, '', np.ones((1, 2)), np.eye(2)[None], one, np.ones(1))
    placed(d, '', np.zeros(3), 2.0)
