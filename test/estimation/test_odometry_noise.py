# SPDX-License-Identifier: Apache-2.0
"""Noise of a robot's wheels, as its scans and reflectors show it."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import SECOND

from rlml_slam import se2
from rlml_slam.estimation.odometry_noise import AXES, LEAST, OdometryNoise
from rlml_slam.motion import motion_of
from rlml_slam.params import MotionNoise
from rlml_slam.types import Motion, Observation

NOISE = MotionNoise()
SEEN = np.diag([0.004, 0.004, 0.002]) ** 2  # of a pose that is measured


def motion(v, w, dt):
    return motion_of(
        se2.exp(np.array([v, 0.0, w]) * dt), dt, replace(NOISE, long_interval_noise=0)
    )


def drive(noise, steps, rng, sigmas=1.0, v=0.8, w=0.0, dt=0.1, seen=SEEN):
    """Last shares (2,) of wheels that err ``sigmas`` times as much as the parameters say."""
    pose, P, scaled = np.zeros(3), seen.copy(), None
    true = motion(v, w, dt)
    for k in range(steps):
        wheels = Motion(true.delta, true.cov)
        scaled = noise.scaled(Observation((k + 1) * SECOND, motion=wheels), dt).motion
        error = sigmas * np.linalg.cholesky(true.cov + 1e-12 * np.eye(3)) @ rng.standard_normal(3)
        predicted, P_new = pose + error, P + scaled.cov
        K = P_new @ np.linalg.inv(P_new + seen)
        z = np.linalg.cholesky(seen) @ rng.standard_normal(3)
        updated, P = predicted + K @ (z - predicted), (np.eye(3) - K) @ P_new
        noise.learn(scaled, (predicted, P_new), (updated, P))
        pose = updated  # the error of it: the truth is at zero
    return np.diag(scaled.cov)[AXES] / np.diag(true.cov)[AXES]


@pytest.mark.parametrize('sigmas', [1.0, 0.7, 0.4])
@pytest.mark.parametrize('w', [0.0, 0.8])
def test_share_of_the_noise_is_found(sigmas, w):
    found = [drive(OdometryNoise(NOISE), 1500, np.random.default_rng(s), sigmas, w=w)
             for s in range(6)]  # fmt: skip
    assert np.mean(found, axis=0) == pytest.approx(np.full(2, sigmas**2), rel=0.25)


def test_wheels_worse_than_the_parameters_keep_their_noise():
    shares = drive(OdometryNoise(NOISE), 500, np.random.default_rng(0), sigmas=2.0)
    assert np.allclose(shares, 1.0)


def test_perfect_wheels_keep_a_least_noise():
    shares = drive(OdometryNoise(NOISE), 2000, np.random.default_rng(0), sigmas=0.0)
    assert shares[1] == pytest.approx(LEAST)


def test_covariance_stays_one():
    noise = OdometryNoise(NOISE)
    drive(noise, 1000, np.random.default_rng(0), sigmas=0.2, w=0.8)
    cov = noise.scaled(Observation(SECOND, motion=motion(0.8, 0.8, 0.1)), 0.1).motion.cov
    assert (np.linalg.eigvalsh(cov) > 0.0).all()


def test_noise_of_turns_is_not_learned_on_straight_ways():
    noise = OdometryNoise(NOISE)
    drive(noise, 1000, np.random.default_rng(0), sigmas=0.2)
    turning = motion(0.8, 0.8, 0.1)
    scaled = noise.scaled(Observation(SECOND, motion=turning), 0.1).motion
    assert scaled.cov[2, 2] == pytest.approx(turning.cov[2, 2])


def test_wheels_that_begin_to_slip_are_doubted_again():
    noise, rng = OdometryNoise(NOISE), np.random.default_rng(0)
    before = drive(noise, 1000, rng, sigmas=0.3)[1]
    assert drive(noise, 200, rng, sigmas=1.0)[1] > 3.0 * before


def test_what_is_not_seen_says_nothing():
    noise, rng = OdometryNoise(NOISE), np.random.default_rng(0)
    blind = np.diag([10.0, 10.0, 1.0]) ** 2
    shares = drive(noise, 300, rng, sigmas=0.2, seen=blind)
    assert np.allclose(shares, 1.0)


@pytest.mark.parametrize(('dt', 'known'), [(3.0, True), (0.1, False), (0.0, True)])
def test_gap_and_unknown_motion_keep_their_noise(dt, known):
    noise = OdometryNoise(NOISE)
    drive(noise, 1000, np.random.default_rng(0), sigmas=0.2)
    given = Observation(SECOND, motion=replace(motion(0.5, 0.0, 3.0), known=known))
    assert noise.scaled(given, dt) is given


def test_motion_that_is_not_the_wheels_says_nothing_of_them():
    noise = OdometryNoise(NOISE)
    given = Observation(SECOND, motion=motion(0.8, 0.0, 0.1))
    noise.scaled(given, 0.1)
    onward = motion(0.7, 0.0, 0.1)
    far = np.array([9.0, 0.0, 1.0])
    noise.learn(onward, (np.zeros(3), onward.cov + SEEN), (far, SEEN))
    assert not noise._sums.any()
    scaled = noise.scaled(given, 0.1).motion
    noise.learn(scaled, (np.zeros(3), scaled.cov + SEEN), (far, SEEN))
    assert noise._sums.any()


def test_wheels_that_jitter_where_the_robot_stands_say_nothing():
    noise, rng = OdometryNoise(NOISE), np.random.default_rng(0)
    drive(noise, 2000, rng, sigmas=0.0, v=0.001, w=0.001)
    assert not noise._sums.any()
    assert drive(noise, 1, rng, v=0.15)[0] == 1.0  # it creeps off
