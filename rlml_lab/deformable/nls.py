# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton over all poses and features of a run, from dead reckoning.

Residuals are whitened: odometry, feature, edge (construction) and smooth, each divided by its
sigma. Neighbouring steps alone share residuals, so the normal equations H dx = -g are block
tridiagonal. Pose 1 is exactly 0: its rows of H are those of the identity and it never moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_lab.deformable.ekf import dead_reckoning
from rlml_lab.deformable.experiment import Measurements, edges
from rlml_slam.compiled import kernel, part
from rlml_slam.deformable.block_tridiagonal import factorize, solve, solve_upper
from rlml_slam.deformable.model import Indices, Noise, motion, observe_feature
from rlml_slam.se2 import Array

MAX_ITERATIONS = 50
TOLERANCE = 1e-9  # largest component of a step [m, rad]


class Smoothed(NamedTuple):
    """The optimum of S runs.

    ``mean`` (S, N, n), ``cov`` (S, N, n, n) marginals, ``information`` H as ``diagonal``
    (S, N, n, n) and ``below`` (S, N-1, n, n), ``cost`` (S,) sum of squared whitened residuals,
    ``iterations`` (S,), ``converged`` (S,).
    """

    mean: Array
    cov: Array
    diagonal: Array
    below: Array
    cost: Array
    iterations: Indices
    converged: NDArray[np.bool_]


def marginals(diagonal: Array, below: Array, cov: Array) -> None:
    """Cov (N, n, n) <- the diagonal blocks of A^-1, after factorize.

    Sigma_ii = L_ii^-T (I + L_{i+1,i}^T Sigma_{i+1,i+1} L_{i+1,i}) L_ii^-1, from the last block.
    """
    N, n, _ = diagonal.shape
    for i in range(N - 1, -1, -1):
        inner = np.eye(n)
        if i + 1 < N:
            inner += below[i].T @ cov[i + 1] @ below[i]
        for _ in range(2):  # the columns, then the rows
            inner = inner.T.copy()
            for row in inner:
                solve_upper(diagonal[i], row)
        cov[i] = 0.5 * (inner + inner.T)


@part
def _add_motion(
    before: Array, after: Array, control: Array, drift: Array, noise: Noise, A: Array, B: Array,
    C: Array, g: Array, h: Array,
) -> float:  # fmt: skip
    """Odometry and smooth residuals of one step; returns their cost.

    e = X_{i+1} - f(X_i), d e / d X_{i+1} = I, d e / d X_i = -F. ``A``, ``B``, ``C`` are H_ii,
    H_{i+1,i} and H_{i+1,i+1}; ``g`` and ``h`` the gradients of the two states.
    """
    x, y, theta, a, b = motion(before[0], before[1], before[2], control)
    w_p, w_t, w_f = 1.0 / noise.position**2, 1.0 / noise.heading**2, 1.0 / noise.drift2
    ex, ey, et = after[0] - x, after[1] - y, after[2] - theta
    A[0, 0] += w_p
    A[1, 1] += w_p
    A[0, 2] += w_p * a
    A[2, 0] += w_p * a
    A[1, 2] += w_p * b
    A[2, 1] += w_p * b
    A[2, 2] += w_p * (a * a + b * b) + w_t
    B[0, 0] -= w_p
    B[0, 2] -= w_p * a
    B[1, 1] -= w_p
    B[1, 2] -= w_p * b
    B[2, 2] -= w_t
    C[0, 0] += w_p
    C[1, 1] += w_p
    C[2, 2] += w_t
    g[0] -= w_p * ex
    g[1] -= w_p * ey
    g[2] -= w_p * (a * ex + b * ey) + w_t * et
    h[0] += w_p * ex
    h[1] += w_p * ey
    h[2] += w_t * et
    cost: float = w_p * (ex * ex + ey * ey) + w_t * et * et
    for j in range(len(drift)):
        for r in range(2):
            k = 3 + 2 * j + r
            e = after[k] - before[k] - drift[j, r]
            A[k, k] += w_f
            B[k, k] -= w_f
            C[k, k] += w_f
            g[k] -= w_f * e
            h[k] += w_f * e
            cost += w_f * e * e
    return cost


@part
def _add_sightings(
    state: Array, feature: Array, sigma: Array, edge: Array, pairs: Indices, noise: Noise,
    A: Array, g: Array,
) -> float:  # fmt: skip
    """Feature and edge residuals of one step; returns their cost. What is NaN adds nothing."""
    z, H, index = np.empty(2), np.empty((2, 5)), np.array([0, 1, 2, 0, 0])
    cost = 0.0
    for j in range(len(feature)):
        if math.isnan(sigma[j]):
            continue
        observe_feature(state, j, z, H)
        index[3], index[4] = 3 + 2 * j, 4 + 2 * j
        weight = 1.0 / sigma[j] ** 2
        for r in range(2):
            e = z[r] - feature[j, r]
            cost += weight * e * e
            for k in range(5):
                g[index[k]] += weight * H[r, k] * e
                for m in range(5):
                    A[index[k], index[m]] += weight * H[r, k] * H[r, m]
    weight = 1.0 / noise.edge**2
    for p in range(len(pairs)):
        if math.isnan(edge[p, 0]):
            continue
        for r in range(2):
            k, m = 3 + 2 * pairs[p, 0] + r, 3 + 2 * pairs[p, 1] + r
            e = state[m] - state[k] - edge[p, r]
            cost += weight * e * e
            g[k] -= weight * e
            g[m] += weight * e
            A[k, k] += weight
            A[m, m] += weight
            A[k, m] -= weight
            A[m, k] -= weight
    return cost


@kernel
def linearize(
    state: Array, control: Array, drift: Array, feature: Array, sigma: Array, edge: Array,
    pairs: Indices, noise: Noise, diagonal: Array, below: Array, g: Array,
) -> float:  # fmt: skip
    """H and the gradient of half the cost of one run at ``state`` (N, n); returns the cost."""
    diagonal[:] = 0.0
    below[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(len(state)):
        cost += _add_sightings(
            state[i], feature[i], sigma[i], edge[i], pairs, noise, diagonal[i], g[i]
        )  # fmt: skip
        if i + 1 < len(state):
            cost += _add_motion(
                state[i], state[i + 1], control[i], drift[i], noise, diagonal[i], below[i],
                diagonal[i + 1], g[i], g[i + 1],
            )  # fmt: skip
    diagonal[0, :3, :] = 0.0
    diagonal[0, :, :3] = 0.0
    below[0, :, :3] = 0.0
    for k in range(3):
        diagonal[0, k, k] = 1.0
        g[0, k] = 0.0
    return cost


def run_nls(measurements: Measurements, noise: Noise, start: Array | None = None) -> Smoothed:
    """The smoothed estimate of S runs; ``start`` (S, N, n) is dead reckoning unless given."""
    m = measurements
    mean = dead_reckoning(m) if start is None else np.array(start)
    S, N, n = mean.shape
    pairs = edges((n - 3) // 2)
    out = Smoothed(
        mean, np.zeros((S, N, n, n)), np.zeros((S, N, n, n)), np.zeros((S, N - 1, n, n)),
        np.zeros(S), np.zeros(S, np.int64), np.zeros(S, np.bool_),
    )  # fmt: skip
    g = np.empty((N, n))
    for run in range(S):
        for iteration in range(MAX_ITERATIONS + 1):
            out.cost[run] = linearize(
                mean[run], m.control[run], m.drift[run], m.feature[run], m.sigma[run],
                m.edge[run], pairs, noise, out.diagonal[run], out.below[run], g,
            )  # fmt: skip
            A, B = out.diagonal[run].copy(), out.below[run].copy()
            if not factorize(A, B) or out.converged[run] or iteration == MAX_ITERATIONS:
                break
            solve(A, B, g)
            mean[run] -= g
            out.iterations[run] = iteration + 1
            out.converged[run] = np.max(np.abs(g)) < TOLERANCE
        marginals(A, B, out.cov[run])
        out.cov[run, 0, :3, :3] = 0.0  # pose 1 is known
    return out
