# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filter over the pose and the features, with dead reckoning beside it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rlml_lab.deformable.experiment import Measurements, edges
from rlml_slam.compiled import kernel
from rlml_slam.deformable.covariance import absorb, advance
from rlml_slam.deformable.model import Indices, Noise, motion, observe_feature
from rlml_slam.se2 import Array


class Estimate(NamedTuple):
    """Means (S, N, n) and covariances (S, N, n, n) of every step."""

    mean: Array
    cov: Array


def predict(state: Array, P: Array, control: Array, drift: Array, noise: Noise) -> None:
    """The state one step on, in place: P <- F P F^T + Q, Q = diag(noise of pose and features).

    ``drift`` (M, 2) is the nominal translation of each feature.
    """
    x, y, theta, a, b = motion(state[0], state[1], state[2], control)
    state[:3] = x, y, theta
    state[3:] += drift.reshape(-1)
    advance(P, a, b, noise)


@kernel
def update(
    state: Array, P: Array, feature: Array, sigma: Array, edge: Array, pairs: Indices, noise: Noise
) -> None:
    """All features seen (``sigma`` not NaN) and all edges (not NaN) at once, in place.

    Every row is linearised at the predicted state and the noise is diagonal, so absorbing the
    rows one after the other is the joint update exactly.
    """
    n, M = len(state), len(feature)
    predicted, gain = np.empty(n), np.empty(n)
    for k in range(n):
        predicted[k] = state[k]
    z, H, index = np.empty(2), np.empty((2, 5)), np.array([0, 1, 2, 0, 0])
    for j in range(M):
        if math.isnan(sigma[j]):
            continue
        observe_feature(predicted, j, z, H)
        index[3], index[4] = 3 + 2 * j, 4 + 2 * j
        for r in range(2):
            innovation = feature[j, r] - z[r]
            for k in range(5):
                innovation -= H[r, k] * (state[index[k]] - predicted[index[k]])
            absorb(P, index, H[r], sigma[j] ** 2, gain)
            for k in range(n):
                state[k] += gain[k] * innovation
    difference, ends = np.array([-1.0, 1.0]), np.empty(2, np.int64)
    for e in range(len(pairs)):
        if math.isnan(edge[e, 0]):
            continue
        for r in range(2):
            ends[0], ends[1] = 3 + 2 * pairs[e, 0] + r, 3 + 2 * pairs[e, 1] + r
            innovation = edge[e, r] - (state[ends[1]] - state[ends[0]])
            absorb(P, ends, difference, noise.edge**2, gain)
            for k in range(n):
                state[k] += gain[k] * innovation


def initialize(
    state: Array, P: Array, feature: Array, sigma: Array, edge: Array, pairs: Indices, noise: Noise
) -> None:
    """Step 1: pose exactly 0, each feature where it is seen, then the edges, in place."""
    state[:3], state[3:] = 0.0, feature.reshape(-1)
    P[:] = np.diag([0.0, 0.0, 0.0, *np.repeat(sigma**2, 2)])
    update(state, P, feature, np.full(len(sigma), np.nan), edge, pairs, noise)


def run_ekf(measurements: Measurements, noise: Noise) -> Estimate:
    """The filtered estimate of S runs; every feature must be seen at step 1."""
    m = measurements
    S, N, M, _ = m.feature.shape
    n, pairs = 3 + 2 * M, edges(M)
    mean, cov = np.zeros((S, N, n)), np.zeros((S, N, n, n))
    for run in range(S):
        state, P = mean[run], cov[run]
        feature, sigma, edge = m.feature[run], m.sigma[run], m.edge[run]
        initialize(state[0], P[0], feature[0], sigma[0], edge[0], pairs, noise)
        for i in range(1, N):
            state[i], P[i] = state[i - 1], P[i - 1]
            predict(state[i], P[i], m.control[run, i - 1], m.drift[run, i - 1], noise)
            update(state[i], P[i], feature[i], sigma[i], edge[i], pairs, noise)
    return Estimate(mean, cov)


def dead_reckoning(measurements: Measurements) -> Array:
    """States (S, N, n) from the controls, the first sighting and the nominal translation."""
    m = measurements
    S, N, M, _ = m.feature.shape
    mean = np.zeros((S, N, 3 + 2 * M))
    mean[:, 0, 3:] = m.feature[:, 0].reshape(S, -1)
    for run in range(S):
        for i in range(1, N):
            before, after = mean[run, i - 1], mean[run, i]
            after[:3] = motion(before[0], before[1], before[2], m.control[run, i - 1])[:3]
            after[3:] = before[3:] + m.drift[run, i - 1].reshape(-1)
    return mean
