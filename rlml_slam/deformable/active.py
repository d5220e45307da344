# SPDX-License-Identifier: Apache-2.0
"""Active control: the step whose predicted belief is the least uncertain.

33 candidates for the next displacement: the nominal one plus an offset (none, or 0.25, 0.5, 0.75
or 1 m in 8 directions); the turn stays as predetermined. Each is rolled out over the horizon with
the nominal motion after the first step. The cost is the trace of the posterior 9x9 covariance,
summed over the horizon, each feature's information weighted with the probability that it is in
range. The covariance of the pose alone would reward leaving the features and dead-reckoning.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import kernel
from rlml_slam.deformable.covariance import absorb, advance
from rlml_slam.deformable.model import (
    Indices,
    Noise,
    Sensor,
    in_range_probability,
    motion,
    observe_feature,
    sigma_at,
)
from rlml_slam.se2 import Array

HORIZON = 6
RADII = (0.25, 0.5, 0.75, 1.0)
DIRECTIONS = 8


def offsets() -> Array:
    """The 33 offsets (33, 2) [m]; the first is none, so that a tie keeps the plan."""
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([np.zeros((1, 2)), *(r * ring for r in RADII)])


@kernel
def _separation(P: Array, j: int, S: Array) -> None:
    """S (2, 2), the covariance of f_j - p."""
    f = 3 + 2 * j
    for r in range(2):
        for c in range(2):
            S[r, c] = P[r, c] - P[r, f + c] - P[f + r, c] + P[f + r, f + c]


@kernel
def rollout(
    state: Array, P: Array, control: Array, translation: Array, pairs: Indices, noise: Noise,
    sensor: Sensor, limit: float,
) -> float:  # fmt: skip
    """Summed trace of the posterior covariance over a plan; state and P are used up.

    ``control`` (H, 3), ``translation`` (H, 2). Stops early, with what it has, above ``limit``.
    """
    n = len(state)
    M = (n - 3) // 2
    gain, z, H, S = np.empty(n), np.empty(2), np.empty((2, 5)), np.empty((2, 2))
    index, ends = np.array([0, 1, 2, 0, 0]), np.empty(2, np.int64)
    difference = np.array([-1.0, 1.0])
    chance = np.empty(M)
    cost = 0.0
    for step in range(len(control)):
        x, y, theta, a, b = motion(state[0], state[1], state[2], control[step])
        state[0], state[1], state[2] = x, y, theta
        for k in range(3, n, 2):
            state[k] += translation[step, 0]
            state[k + 1] += translation[step, 1]
        advance(P, a, b, noise)
        for j in range(M):
            _separation(P, j, S)
            dx, dy = state[3 + 2 * j] - x, state[4 + 2 * j] - y
            chance[j] = in_range_probability(dx, dy, S, sensor.near, sensor.far)
        for j in range(M):
            if chance[j] < 1e-6:
                continue
            observe_feature(state, j, z, H)
            variance = sigma_at(math.hypot(z[0], z[1]), sensor) ** 2 / chance[j]
            index[3], index[4] = 3 + 2 * j, 4 + 2 * j
            for r in range(2):
                absorb(P, index, H[r], variance, gain)
        for e in range(len(pairs)):
            for r in range(2):
                ends[0], ends[1] = 3 + 2 * pairs[e, 0] + r, 3 + 2 * pairs[e, 1] + r
                absorb(P, ends, difference, noise.edge**2, gain)
        for k in range(n):
            cost += P[k, k]
        if cost > limit:
            break
    return cost


@kernel
def choose_control(
    state: Array, P: Array, planned: Array, translation: Array, candidates: Array, pairs: Indices,
    noise: Noise, sensor: Sensor, best: Array,
) -> float:  # fmt: skip
    """Control of the cheapest candidate into ``best`` (3,); its cost.

    ``planned`` (H, 3) and ``translation`` (H, 2) are the nominal motion from the present step on;
    ``candidates`` (K, 2) offsets in the robot's frame. The belief (state, P) is only read.
    """
    control = planned.copy()
    lowest = math.inf
    for k in range(len(candidates)):
        control[0, 0] = planned[0, 0] + candidates[k, 0]
        control[0, 1] = planned[0, 1] + candidates[k, 1]
        cost = rollout(
            state.copy(), P.copy(), control, translation, pairs, noise, sensor, lowest
        )  # fmt: skip
        if cost < lowest:
            lowest = cost
            best[:] = control[0]
    return lowest
