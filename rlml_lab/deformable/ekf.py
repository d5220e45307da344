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


@kernel
def predict(state: Array, P: Array, control: Array, drift: Array, noise: Noise) -> None:
    """The state one step on, in place: P <- F P F^T + Q, Q = diag(noise of pose and features).

    ``drift`` (M, 2) is the nominal translation of each feature.
    """
    x, y, theta, a, b = motion(state[0], state[1], state[2], control)
    state[0], state[1], state[2] = x, y, theta
    for j in range(len(drift)):
        state[3 + 2 * j] += drift[j, 0]
        state[4 + 2 * j] += drift[j, 1]
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
    predicted, gain = state.copy(), np.empty(n)
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
            state += gain * innovation
    difference, ends = np.array([-1.0, 1.0]), np.empty(2, np.int64)
    for e in range(len(pairs)):
        if math.isnan(edge[e, 0]):
            continue
        for r in range(2):
            ends[0], ends[1] = 3 + 2 * pairs[e, 0] + r, 3 + 2 * pairs[e, 1] + r
            innovation = edge[e, r] - (state[ends[1]] - state[ends[0]])
            absorb(P, ends, difference, noise.edge**2, gain)
            state += gain * innovation


@kernel
def initialize(
    state: Array, P: Array, feature: Array, sigma: Array, edge: Array, pairs: Indices, noise: Noise
) -> None:
    """Step 1: pose exactly 0, each feature where it is seen, then the edges, in place."""
    state[:] = 0.0
    P[:] = 0.0
    unseen = np.full(len(sigma), np.nan)
    for j in range(len(sigma)):
        for r in range(2):
            state[3 + 2 * j + r] = feature[j, r]
            P[3 + 2 * j + r, 3 + 2 * j + r] = sigma[j] ** 2
    update(state, P, feature, unseen, edge, pairs, noise)


@kernel
def _filter(
    control: Array, drift: Array, feature: Array, sigma: Array, edge: Array, pairs: Indices,
    noise: Noise, mean: Array, cov: Array,
) -> None:  # fmt: skip
    for run in range(len(mean)):
        state, P = mean[run], cov[run]
        initialize(
            state[0], P[0], feature[run, 0], sigma[run, 0], edge[run, 0], pairs, noise
        )  # fmt: skip
        for i in range(1, mean.shape[1]):
            state[i], P[i] = state[i - 1], P[i - 1]
            predict(state[i], P[i], control[run, i - 1], drift[run, i - 1], noise)
            update(
                state[i], P[i], feature[run, i], sigma[run, i], edge[run, i], pairs, noise
            )  # fmt: skip


def run_ekf(measurements: Measurements, noise: Noise) -> Estimate:
    """The filtered estimate of S runs; every feature must be seen at step 1."""
    S, N, M, _ = measurements.feature.shape
    n = 3 + 2 * M
    mean, cov = np.zeros((S, N, n)), np.zeros((S, N, n, n))
    m = measurements
    _filter(m.control, m.drift, m.feature, m.sigma, m.edge, edges(M), noise, mean, cov)
    return Estimate(mean, cov)


@kernel
def _reckon(control: Array, drift: Array, feature: Array, mean: Array) -> None:
    S, N, _ = mean.shape
    for run in range(S):
        mean[run, 0, 3:] = feature[run, 0].reshape(-1)
        for i in range(1, N):
            before, after = mean[run, i - 1], mean[run, i]
            x, y, theta, _, _ = motion(before[0], before[1], before[2], control[run, i - 1])
            after[0], after[1], after[2] = x, y, theta
            after[3:] = before[3:] + drift[run, i - 1].reshape(-1)


def dead_reckoning(measurements: Measurements) -> Array:
    """States (S, N, n) from the controls, the first sighting and the nominal translation."""
    m = measurements
    S, N, M, _ = m.feature.shape
    mean = np.zeros((S, N, 3 + 2 * M))
    _reckon(m.control, m.drift, m.feature, mean)
    return mean
