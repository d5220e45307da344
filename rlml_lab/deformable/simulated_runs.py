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
from rlml_slam.compiled import kernel, part
from rlml_slam.deformable.active import HORIZON, choose_control, offsets
from rlml_slam.deformable.model import Indices, Noise, Sensor, motion, observe_feature, sigma_at
from rlml_slam.se2 import Array


@part
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


@part
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
            feature[j, 0], feature[j, 1], sigma[j] = np.nan, np.nan, np.nan
            continue
        sigma[j] = sigma_at(distance, sensor)
        for r in range(2):
            feature[j, r] = z[r] + sigma[j] * draw_feature[j, r]
    for e in range(len(pairs)):
        for r in range(2):
            difference = state[3 + 2 * pairs[e, 1] + r] - state[3 + 2 * pairs[e, 0] + r]
            edge[e, r] = difference + noise.edge * draw_edge[e, r]


@kernel
def _drive(
    start: int, stop: int, control: Array, translation: Array, odometry: Array, walk: Array,
    draw_feature: Array, draw_edge: Array, pairs: Indices, noise: Noise, sensor: Sensor,
    truth: Array, feature: Array, sigma: Array, edge: Array,
) -> None:  # fmt: skip
    """The true states of the steps from ``start`` to before ``stop``, and what is measured."""
    for i in range(start, stop):
        if i > 0:
            for k in range(truth.shape[1]):
                truth[i, k] = truth[i - 1, k]
            _move(
                truth[i], control[i - 1], translation[i - 1], odometry[i - 1], walk[i - 1], noise
            )  # fmt: skip
        _measure(
            truth[i], i == 0, draw_feature[i], draw_edge[i], pairs, noise, sensor, feature[i],
            sigma[i], edge[i],
        )  # fmt: skip


def simulate(row: Row, draws: Draws) -> tuple[Array, Measurements]:
    """True states (S, N, n) and the measurements of ``row``; draws of 0 make a noiseless world.

    The controller knows the EKF's belief and the plan, nothing of the truth.
    """
    plan = nominal(row.path, HORIZON)
    S, N, M, _ = draws.feature.shape
    n, pairs = 3 + 2 * M, edges(M)
    noise, sensor, candidates = Noise(), SENSORS[row.sensing], offsets()
    truth, control = np.empty((S, N, n)), np.tile(plan.control[: N - 1], (S, 1, 1))
    feature, sigma = np.empty((S, N, M, 2)), np.empty((S, N, M))
    edge = np.empty((S, N, len(pairs), 2))
    drift = np.broadcast_to(plan.translation[: N - 1, None], (S, N - 1, M, 2)).copy()
    belief, P = np.empty(n), np.empty((n, n))
    for run in range(S):
        truth[run, 0, :3], truth[run, 0, 3:] = 0.0, START_FEATURES.reshape(-1)
        u, z, s, e = control[run], feature[run], sigma[run], edge[run]
        world = (
            u, plan.translation, draws.odometry[run], draws.drift[run], draws.feature[run],
            draws.edge[run], pairs, noise, sensor, truth[run], z, s, e,
        )  # fmt: skip
        if row.control == 'predetermined':
            _drive(0, N, *world)
            continue
        _drive(0, 1, *world)
        initialize(belief, P, z[0], s[0], e[0], pairs, noise)
        for i in range(1, N):
            # the plan is the same at every step
            planned, ahead = np.tile(u[i - 1], (HORIZON, 1)), plan.translation[i - 1 :][:HORIZON]
            choose_control(
                belief, P, planned, ahead, candidates, pairs, noise, sensor, u[i - 1]
            )  # fmt: skip
            _drive(i, i + 1, *world)
            predict(belief, P, u[i - 1], drift[run, i - 1], noise)
            update(belief, P, z[i], s[i], e[i], pairs, noise)
    return truth, Measurements(control, drift, feature, sigma, edge)
