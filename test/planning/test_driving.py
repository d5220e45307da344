# SPDX-License-Identifier: Apache-2.0
"""The sigma while driving is that of the front end's own prediction and update, repeated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rlml_slam.motion import motion_of
from rlml_slam.params import Parameters
from rlml_slam.planning.bound import bound, reflector_information, sigmas
from rlml_slam.planning.driving import motion_variance, predicted
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.joint_state import JointState

P = Parameters()
SPEED, INTERVAL = 1.0, 0.1
UPPER = np.triu_indices(3)


def steady_sigma(row: Array, heading: float) -> float:
    """Position sigma after 20 s of driving where every scan has the information ``row`` (6,)."""
    M = np.zeros((3, 3))
    M[UPPER] = row
    root = np.linalg.cholesky(M + np.triu(M, 1).T).T
    state = JointState(np.array([0.0, 0.0, heading]), np.diag([1.0, 1.0, 0.1]), 0.0)
    motion = motion_of(np.array([SPEED * INTERVAL, 0.0, 0.0]), INTERVAL, P.motion)
    for _ in range(200):
        state.predict(motion, 0.0)
        state.x[:3] = 0.0, 0.0, heading
        state.apply(np.arange(3), root, np.eye(3), np.zeros(3))
    return math.sqrt(np.linalg.eigvalsh(state.pose_cov[:2, :2])[-1])


@pytest.mark.parametrize('width', [1.0, 0.06], ids=['all around', 'along a corridor'])
def test_sigma_while_driving_is_the_steady_state_of_the_filter(width):
    rng, q = np.random.default_rng(5), motion_variance(SPEED, INTERVAL, P.motion)
    for _ in range(4):
        k = int(rng.integers(2, 9))
        offsets = rng.uniform(-20.0, 20.0, (k, 2)) * (1.0, width)
        row = reflector_information(offsets, np.zeros((k, 2, 2)), P.reflector).sum(axis=0)
        planned = float(sigmas(row + predicted(row, q))[0])
        worst = max(steady_sigma(row, h) for h in np.arange(4) * math.pi / 4.0)
        # never better than the filter; heading counts from each scan alone: up to 5 % worse
        assert 0.9999 * worst <= planned <= 1.06 * worst
        assert planned < sigmas(row)[0]


def test_what_no_scan_measures_stays_open():
    assert np.isinf(sigmas(predicted(np.zeros(6), 1e-4))[0])


def test_slow_odometry_is_a_single_scan_in_the_limit():
    points, places = np.array([[4.0, 1.0], [-3.0, 5.0], [2.0, -6.0]]), np.zeros((1, 2))
    seen, cov = np.ones((1, 3), dtype=np.bool_), np.zeros((3, 2, 2))
    single = bound(places, seen, points, cov, P.reflector)
    loose = bound(places, seen, points, cov, P.reflector, q=1e6)
    np.testing.assert_allclose(loose.position, single.position, rtol=1e-6)
    np.testing.assert_allclose(loose.hidden, single.hidden, rtol=1e-6)
    tight = bound(places, seen, points, cov, P.reflector, q=1e-5)
    assert (tight.hidden[:, 0] < single.hidden[:, 0]).all()
