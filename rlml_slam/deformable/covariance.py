# SPDX-License-Identifier: Apache-2.0
"""One step of a Kalman filter on the covariance alone: prediction and scalar update, in place."""

from __future__ import annotations

from rlml_slam.compiled import kernel
from rlml_slam.deformable.model import Indices, Noise
from rlml_slam.se2 import Array


@kernel
def advance(P: Array, a: float, b: float, noise: Noise) -> None:
    """P <- F P F^T + Q with F = I but d x / d theta = a and d y / d theta = b."""
    n = len(P)
    for k in range(n):
        P[0, k] += a * P[2, k]
        P[1, k] += b * P[2, k]
    for k in range(n):
        P[k, 0] += a * P[k, 2]
        P[k, 1] += b * P[k, 2]
    P[0, 0] += noise.position**2
    P[1, 1] += noise.position**2
    P[2, 2] += noise.heading**2
    for k in range(3, n):
        P[k, k] += noise.drift2


@kernel
def absorb(P: Array, index: Indices, h: Array, variance: float, gain: Array) -> None:
    """One scalar measurement with row ``h`` at the state entries ``index``: P <- P - g g^T / s.

    ``gain`` (n,) becomes K = g / s with g = P h and s = h^T P h + variance.
    """
    n = len(P)
    s = variance
    for i in range(n):
        g = 0.0
        for k in range(len(index)):
            g += P[i, index[k]] * h[k]
        gain[i] = g
    for k in range(len(index)):
        s += h[k] * gain[index[k]]
    for i in range(n):
        for j in range(n):
            P[i, j] -= gain[i] * gain[j] / s
    for i in range(n):
        gain[i] /= s
