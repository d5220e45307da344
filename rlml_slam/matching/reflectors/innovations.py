# SPDX-License-Identifier: Apache-2.0
"""Innovations of detections against reflectors (eq. 1), with what they share, in one go each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array


@kernel
def expected(pose: Array, x: float, y: float, z: Array, J: Array) -> None:
    """R(theta)^T (m - p) of a reflector m = (x, y) into z (2,), and its Jacobian into J (2, 5).

    The Jacobian is by the pose (p, theta) and by m.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = x - pose[0], y - pose[1]
    z[0], z[1] = c * dx + s * dy, c * dy - s * dx
    J[0, 3], J[0, 4], J[1, 3], J[1, 4] = c, s, -s, c
    J[:, 0], J[:, 1] = -J[:, 3], -J[:, 4]
    J[0, 2], J[1, 2] = z[1], -z[0]


@kernel
def pairwise(
    pose: Array, points: Array, cov: Array, spread2: Array, seen: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Innovations nu (k, m, 2), nu^T S^-1 nu (k, m) and log det S (k, m) of all pairs.

    ``pose`` (3,) and reflectors ``points`` (m, 2) with joint covariance ``cov`` (3 + 2m, 3 + 2m);
    detections ``seen`` (k, 2) with covariances ``noise`` (k, 2, 2). ``spread2`` (m,) is variance
    per axis that every detection of a reflector has besides.
    """
    k, m = len(seen), len(points)
    nu, d2, log_det = np.empty((k, m, 2)), np.empty((k, m)), np.empty((k, m))
    z, J = np.empty(2), np.empty((2, 5))
    at, HP = np.arange(5), np.empty((2, 5))
    for j in range(m):
        expected(pose, points[j, 0], points[j, 1], z, J)
        at[3], at[4] = 3 + 2 * j, 4 + 2 * j
        for r in range(2):
            for q in range(5):
                HP[r, q] = 0.0
                for h in range(5):
                    HP[r, q] += J[r, h] * cov[at[h], at[q]]
        s00 = s01 = s11 = 0.0
        for q in range(5):
            s00 += HP[0, q] * J[0, q]
            s01 += HP[0, q] * J[1, q]
            s11 += HP[1, q] * J[1, q]
        for i in range(k):
            a = s00 + noise[i, 0, 0] + spread2[j]
            b = s01 + 0.5 * (noise[i, 0, 1] + noise[i, 1, 0])
            d = s11 + noise[i, 1, 1] + spread2[j]
            u, v = seen[i, 0] - z[0], seen[i, 1] - z[1]
            det = a * d - b * b
            nu[i, j, 0], nu[i, j, 1] = u, v
            d2[i, j] = (d * u * u - 2.0 * b * u * v + a * v * v) / det
            log_det[i, j] = math.log(det)
    return nu, d2, log_det


@kernel
def joint_distance2(
    pose: Array,
    points: Array,
    cov: Array,
    nu: Array,
    noise: Array,
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
) -> float:
    """nu^T S^-1 nu of a whole hypothesis: detection rows[i] is reflector cols[i].

    The other arguments are those and the result of :func:`pairwise`.
    """
    q = len(rows)
    H = np.zeros((q, 2, 5))
    S, v = np.empty((2 * q, 2 * q)), np.empty(2 * q)
    z, at = np.empty(2), np.empty((q, 5), np.int64)
    for i in range(q):
        expected(pose, points[cols[i], 0], points[cols[i], 1], z, H[i])
        at[i, 0], at[i, 1], at[i, 2] = 0, 1, 2
        at[i, 3], at[i, 4] = 3 + 2 * cols[i], 4 + 2 * cols[i]
        v[2 * i : 2 * i + 2] = nu[rows[i], cols[i]]
    HP = np.empty((2, 5))
    for i in range(q):
        for j in range(i + 1):
            for r in range(2):
                for w in range(5):
                    HP[r, w] = 0.0
                    for h in range(5):
                        HP[r, w] += H[i, r, h] * cov[at[i, h], at[j, w]]
            for r in range(2):
                for c in range(2):
                    total = 0.0
                    for w in range(5):
                        total += HP[r, w] * H[j, c, w]
                    S[2 * i + r, 2 * j + c] = total
        S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += noise[rows[i]]
    factorize(S)
    forward(S, v)
    return float(np.sum(v * v))


@part
def factorize(S: Array) -> None:
    """Cholesky factor L of S = L L^T into the lower triangle of S (n, n); NaN if it has none."""
    n = len(S)
    for i in range(n):
        for j in range(i + 1):
            total = S[i, j]
            for h in range(j):
                total -= S[i, h] * S[j, h]
            S[i, j] = math.sqrt(total) if i == j else total / S[j, j]


@part
def forward(L: Array, v: Array) -> None:
    """Solve L w = v in place, L (n, n) the lower triangle, v (n,)."""
    for i in range(len(v)):
        total = v[i]
        for h in range(i):
            total -= L[i, h] * v[h]
        v[i] = total / L[i, i]


@part
def backward(L: Array, v: Array) -> None:
    """Solve L^T w = v in place, L (n, n) the lower triangle, v (n,)."""
    for i in range(len(v) - 1, -1, -1):
        total = v[i]
        for h in range(i + 1, len(v)):
            total -= L[h, i] * v[h]
        v[i] = total / L[i, i]


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    pose, points, one = np.zeros(3), np.ones((1, 2)), np.zeros(1, dtype=np.int64)
    expected(pose, 1.0, 1.0, np.empty(2), np.empty((2, 5)))
    noise = np.eye(2)[None]
    nu, _, _ = pairwise(pose, points, np.eye(5), np.zeros(1), points, noise)
    joint_distance2(pose, points, np.eye(5), nu, noise, one, one)
