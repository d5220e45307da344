# SPDX-License-Identifier: Apache-2.0
"""The truth of S runs and what is measured of it, predetermined or under active control."""

from __future__ import annotations

import math

import numpy as np

from rlml_lab.deformable.ekf import initialize, predict, update
from rlml_lab.deformable.experiment import (
    SENSORS,
    START_FEATURES,
    Draws,
    Measurements,
    Row,
    edges,
    nominal,
)
from rlml_slam.compiled import kernel
from rlml_slam.deformable.active import HORIZON, choose_control, offsets
from rlml_slam.deformable.model import Indices, Noise, Sensor, motion, observe_feature, sigma_at
from rlml_slam.se2 import Array


@kernel
def _move(
    state: Array, control: Array, translation: Array, odometry: Array, drift: Array, noise: Noise
) -> None:
    """The true state one step on, in place; ``odometry`` and ``drift`` are standard normal."""
    x, y, theta, _, _ = motion(state[0], state[1], state[2], control)
    state[0] = x + noise.position * odometry[0]
    state[1] = y + noise.position * odometry[1]
    state[2] = theta + noise.heading * odometry[2]
    for j in range(len(drift)):
        for r in range(2):
            state[3 + 2 * j + r] += translation[r] + math.sqrt(noise.drift2) * drift[j, r]


@kernel
def _measure(
    state: Array, first: bool, draw_feature: Array, draw_edge: Array, pairs: Indices, noise: Noise,
    sensor: Sensor, feature: Array, sigma: Array, edge: Array,
) -> None:  # fmt: skip
    """Measurements of one true state; an unseen feature leaves NaN."""
    z, H = np.empty(2), np.empty((2, 5))
    for j in range(len(feature)):
        observe_feature(state, j, z, H)
        distance = math.hypot(z[0], z[1])
        if not first and not sensor.near <= distance <= sensor.far:
            feature[j] = np.nan
            sigma[j] = np.nan
            continue
        sigma[j] = sigma_at(distance, sensor)
        feature[j] = z + sigma[j] * draw_feature[j]
    for e in range(len(pairs)):
        for r in range(2):
            difference = state[3 + 2 * pairs[e, 1] + r] - state[3 + 2 * pairs[e, 0] + r]
            edge[e, r] = difference + noise.edge * draw_edge[e, r]


@kernel
def _simulate(
    planned: Array, translation: Array, start: Array, odometry: Array, walk: Array,
    draw_feature: Array, draw_edge: Array, pairs: Indices, noise: Noise, sensor: Sensor,
    candidates: Array, truth: Array, control: Array, feature: Array, sigma: Array, edge: Array,
) -> None:  # fmt: skip
    S, N, n = truth.shape
    M = (n - 3) // 2
    horizon = len(translation) - (N - 1)
    drift, belief, P = np.empty((M, 2)), np.empty(n), np.empty((n, n))
    plan = np.empty((horizon, 3))
    for run in range(S):
        state = truth[run]
        state[0, :3] = 0.0
        state[0, 3:] = start
        for i in range(N):
            if i > 0:
                if len(candidates) == 0:
                    control[run, i - 1] = planned[i - 1]
                else:
                    plan[:] = planned[i - 1]  # the plan is the same at every step
                    ahead = translation[i - 1 : i - 1 + horizon]
                    choose_control(
                        belief, P, plan, ahead, candidates, pairs, noise, sensor,
                        control[run, i - 1],
                    )  # fmt: skip
                state[i] = state[i - 1]
                _move(
                    state[i], control[run, i - 1], translation[i - 1], odometry[run, i - 1],
                    walk[run, i - 1], noise,
                )  # fmt: skip
            _measure(
                state[i], i == 0, draw_feature[run, i], draw_edge[run, i], pairs, noise, sensor,
                feature[run, i], sigma[run, i], edge[run, i],
            )  # fmt: skip
            if len(candidates) == 0:
                continue
            z, s, e = feature[run, i], sigma[run, i], edge[run, i]
            if i == 0:
                initialize(belief, P, z, s, e, pairs, noise)
            else:
                drift[:] = translation[i - 1]
                predict(belief, P, control[run, i - 1], drift, noise)
                update(belief, P, z, s, e, pairs, noise)


def simulate(row: Row, draws: Draws) -> tuple[Array, Measurements]:
    """True states (S, N, n) and the measurements of ``row``; draws of 0 make a noiseless world.

    The controller knows the EKF's belief and the plan, nothing of the truth.
    """
    plan = nominal(row.path, HORIZON)
    S, N, M, _ = draws.feature.shape
    pairs = edges(M)
    truth, control = np.empty((S, N, 3 + 2 * M)), np.empty((S, N - 1, 3))
    feature, sigma = np.empty((S, N, M, 2)), np.empty((S, N, M))
    edge = np.empty((S, N, len(pairs), 2))
    candidates = offsets() if row.control == 'active' else np.empty((0, 2))
    _simulate(
        plan.control, plan.translation, START_FEATURES.reshape(-1), draws.odometry, draws.drift,
        draws.feature, draws.edge, pairs, Noise(), SENSORS[row.sensing], candidates, truth,
        control, feature, sigma, edge,
    )  # fmt: skip
    drift = np.broadcast_to(plan.translation[: N - 1, None], (S, N - 1, M, 2)).copy()
    return truth, Measurements(control, drift, feature, sigma, edge)
