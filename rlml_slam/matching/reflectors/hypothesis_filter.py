# SPDX-License-Identifier: Apache-2.0
"""Gaussian filters of several association hypotheses at once, in right-invariant coordinates.

A hypothesis h holds the pose (position p, heading theta) and the places l of its reflectors, as
mean ``x`` (n,) = [p, theta, l_1, l_2, ...] and covariance ``P`` (n, n) of the error xi of

    (p, l)_true = Rot(xi_theta) (p, l) + V(xi_theta) xi_(p, l),    theta_true = theta + xi_theta,

the right-invariant error of SE_m(2). A wrong heading turns the whole map about the origin, which
is exact in these coordinates: after half a minute without a sighting, with the heading off by
half a radian, a filter of the plain differences x_true - x rates the true association below a
wrong one; this one does not. The observation of a reflector, turned into the map's axes, is

    Rot(theta) z - (l - p) = xi_l - xi_p + noise,

whose derivative is the same whatever the estimate (Barrau and Bonnabel 2017,
doi:10.1109/TAC.2016.2594085). All
hypotheses share arrays ``x`` (K, N) and ``P`` (K, N, N), of which the first ``sizes[h]`` count.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array

POSE = 3
LOG_2_PI = math.log(2.0 * math.pi)


@kernel
def predict(x: Array, P: Array, sizes: NDArray[np.int64], delta: Array, cov: Array) -> None:
    """Move every pose by ``delta`` (3,) with covariance (3, 3), both in the start frame."""
    for h in range(len(sizes)):
        n = sizes[h]
        c, s = math.cos(x[h, 2]), math.sin(x[h, 2])
        x[h, 0] += c * delta[0] - s * delta[1]
        x[h, 1] += s * delta[0] + c * delta[1]
        x[h, 2] += delta[2]
        # noise of the heading turns all points about the origin
        G = np.zeros((n, 3))
        G[0, 0], G[0, 1], G[1, 0], G[1, 1], G[2, 2] = c, -s, s, c, 1.0
        G[0, 2], G[1, 2] = x[h, 1], -x[h, 0]
        for a in range(POSE, n, 2):
            G[a, 2], G[a + 1, 2] = x[h, a + 1], -x[h, a]
        # the noise is given in the axes at the start; position noise moves the pose alone
        GC = G @ cov
        for a in range(n):
            for b in range(n):
                P[h, a, b] += GC[a, 0] * G[b, 0] + GC[a, 1] * G[b, 1] + GC[a, 2] * G[b, 2]


@part
def innovation(
    x: Array, P: Array, h: int, column: int, z: Array, R: Array
) -> tuple[float, float, float, float, float]:
    """Innovation (2,) in the map's axes and its covariance: (u, v, S_uu, S_uv, S_vv)."""
    c, s = math.cos(x[h, 2]), math.sin(x[h, 2])
    a = column
    u = c * z[0] - s * z[1] - (x[h, a] - x[h, 0])
    v = s * z[0] + c * z[1] - (x[h, a + 1] - x[h, 1])
    Ruu = c * c * R[0, 0] - 2.0 * c * s * R[0, 1] + s * s * R[1, 1]
    Ruv = c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    Rvv = s * s * R[0, 0] + 2.0 * c * s * R[0, 1] + c * c * R[1, 1]
    Puu = P[h, a, a] + P[h, 0, 0] - 2.0 * P[h, a, 0]
    Puv = P[h, a, a + 1] + P[h, 0, 1] - P[h, a, 1] - P[h, 0, a + 1]
    Pvv = P[h, a + 1, a + 1] + P[h, 1, 1] - 2.0 * P[h, a + 1, 1]
    # what turns about the robot moves on an arc: its height over the tangent, of second order
    bend = 0.25 * (Puu + Pvv) ** 2 / (z[0] * z[0] + z[1] * z[1])
    return u, v, Ruu + Puu + bend, Ruv + Puv, Rvv + Pvv + bend


@part
def log_likelihood(u: float, v: float, Suu: float, Suv: float, Svv: float) -> tuple[float, float]:
    """Log density [1/m²] and squared Mahalanobis distance of an innovation."""
    det = Suu * Svv - Suv * Suv
    d2 = (Svv * u * u - 2.0 * Suv * u * v + Suu * v * v) / det
    return -0.5 * d2 - 0.5 * math.log(det) - LOG_2_PI, d2


@kernel
def rate(x: Array, P: Array, sizes: NDArray[np.int64], z: Array, R: Array) -> tuple[Array, Array]:
    """Log density and squared distance (K, m) of z (2,) for each reflector; -inf beyond sizes."""
    columns = (x.shape[1] - POSE) // 2
    density = np.full((len(sizes), columns), -np.inf)
    distance2 = np.full((len(sizes), columns), np.inf)
    for h in range(len(sizes)):
        for j in range((sizes[h] - POSE) // 2):
            u, v, Suu, Suv, Svv = innovation(x, P, h, POSE + 2 * j, z, R)
            density[h, j], distance2[h, j] = log_likelihood(u, v, Suu, Suv, Svv)
    return density, distance2


@kernel
def update(
    x: Array,
    P: Array,
    sizes: NDArray[np.int64],
    labels: NDArray[np.int64],
    z: Array,
    R: Array,
    log_outlier: float,
) -> Array:
    """Use z (2,) for reflector ``labels[h]`` (-1: not) of each hypothesis; log likelihoods (K,).

    Below ``log_outlier``, the density of a detection that is of nothing, it is not used.
    """
    gained = np.zeros(len(sizes))
    for h in range(len(sizes)):
        if labels[h] < 0:
            continue
        n, a = sizes[h], POSE + 2 * labels[h]
        u, v, Suu, Suv, Svv = innovation(x, P, h, a, z, R)
        density, _ = log_likelihood(u, v, Suu, Suv, Svv)
        high, low = max(density, log_outlier), min(density, log_outlier)
        gained[h] = high + math.log1p(math.exp(low - high))
        if density <= log_outlier:
            continue
        det = Suu * Svv - Suv * Suv
        Iuu, Iuv, Ivv = Svv / det, -Suv / det, Suu / det
        C = np.empty((n, 2))
        for i in range(n):
            C[i, 0], C[i, 1] = P[h, i, a] - P[h, i, 0], P[h, i, a + 1] - P[h, i, 1]
        K = np.empty((n, 2))
        for i in range(n):
            K[i, 0] = C[i, 0] * Iuu + C[i, 1] * Iuv
            K[i, 1] = C[i, 0] * Iuv + C[i, 1] * Ivv
        for i in range(n):
            for j in range(n):
                P[h, i, j] -= K[i, 0] * C[j, 0] + K[i, 1] * C[j, 1]
        _retract(x[h], n, K, u, v)
    return gained


@part
def _retract(x: Array, n: int, K: Array, u: float, v: float) -> None:
    """X <- Exp(K nu) X: turn all points about the origin, then shift each."""
    turn = K[2, 0] * u + K[2, 1] * v
    c, s = math.cos(turn), math.sin(turn)
    # V of the exponential map
    A, B = (1.0, 0.5 * turn) if abs(turn) < 1e-8 else (math.sin(turn) / turn, (1.0 - c) / turn)
    x[2] += turn
    for k in range(-1, (n - POSE) // 2):
        i = 0 if k < 0 else POSE + 2 * k
        px, py = x[i], x[i + 1]
        dx, dy = K[i, 0] * u + K[i, 1] * v, K[i + 1, 0] * u + K[i + 1, 1] * v
        x[i] = c * px - s * py + A * dx - B * dy
        x[i + 1] = s * px + c * py + B * dx + A * dy


@kernel
def augment(x: Array, P: Array, n: int, z: Array, R: Array) -> None:
    """Append the reflector seen at z (2,) to one hypothesis of size n, arrays (N,) and (N, N)."""
    c, s = math.cos(x[2]), math.sin(x[2])
    x[n] = x[0] + c * z[0] - s * z[1]
    x[n + 1] = x[1] + s * z[0] + c * z[1]
    for i in range(n):
        P[n, i] = P[i, n] = P[0, i]
        P[n + 1, i] = P[i, n + 1] = P[1, i]
    P[n, n] = P[0, 0] + c * c * R[0, 0] - 2.0 * c * s * R[0, 1] + s * s * R[1, 1]
    P[n, n + 1] = P[0, 1] + c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    P[n + 1, n] = P[n, n + 1]
    P[n + 1, n + 1] = P[1, 1] + s * s * R[0, 0] + 2.0 * c * s * R[0, 1] + c * c * R[1, 1]


def to_invariant(pose: Array, points: Array) -> Array:
    """M (3 + 2m, 3 + 2m): xi = M e for the plain error e of pose (3,), theta last, and points."""
    M = np.eye(POSE + 2 * len(points))
    M[0, 2], M[1, 2] = pose[1], -pose[0]
    M[POSE::2, 2], M[POSE + 1 :: 2, 2] = points[:, 1], -points[:, 0]
    return M


def warm_up() -> None:
    """Compile the kernels."""
    x, P, sizes = np.zeros((1, 5)), np.zeros((1, 5, 5)), np.array([3])
    augment(x[0], P[0], 3, np.ones(2), np.eye(2))
    sizes[0] = 5
    predict(x, P, sizes, np.zeros(3), np.eye(3))
    rate(x, P, sizes, np.ones(2), np.eye(2))
    update(x, P, sizes, np.zeros(1, dtype=np.int64), np.ones(2), np.eye(2), -10.0)
