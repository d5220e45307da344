# SPDX-License-Identifier: Apache-2.0
"""What odometry errs by during a sweep is in the match of its scan, and in the next motion."""

from dataclasses import replace

import numpy as np
import pytest
from made_states import made

from rlml_slam import se2
from rlml_slam.params import MotionNoise, Parameters
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.observation_assembly import ObservationAssembly
from rlml_slam.sensing.synchronization.waiting_queue import Waiting
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.joint_state import (
    LANDMARKS,
    MOVING,
    JointState,
    end_sweep,
)
from rlml_slam.slam.front_end.motion_term import MotionTerm
from rlml_slam.slam.front_end.scan_update import Found, fuse
from rlml_slam.types import Motion, Observation, Odometry, Scan

NOTHING = np.zeros(3)
STEP = 100_000_000  # [ns] between two sweeps, each of which lasts as long
SWEEP_COV = np.diag([0.004, 0.001, 0.008]) ** 2
MATCH_COV = np.diag([0.001, 0.001, 0.0005]) ** 2
SYSTEMATIC_OFF = replace(
    MotionNoise(), scale_error_sigma=(1e-6, 1e-6), drift_sigma=1e-6, imu_bias_sigma=1e-9
)


def scan(stamp, beams=100):
    nothing = np.zeros(0, np.float32)
    step, ranges = STEP * 1e-9 / beams, np.ones(beams, np.float32)
    return Scan(stamp, 'laser', 0.0, 0.1, step, 0.1, 10.0, ranges, nothing)


def observation(k, delta, cov):
    stamp = k * STEP
    return Observation(
        stamp, Motion(delta, cov), scan=scan(stamp), odom_pose=np.zeros(3), sweep=delta[None],
        sweep_cov=SWEEP_COV,
    )  # fmt: skip


def no_fit(_):
    raise AssertionError('there is one motion only')


def estimate(rng, is_used, steps=60):
    """Errors (n, 3) and their NEES (n,), of a robot whose scans are de-skewed by its wheels."""
    params = Parameters(motion=SYSTEMATIC_OFF)
    state, motion = JointState(np.zeros(3), np.zeros((3, 3)), 0.0), MotionTerm(params)
    truth, noise, out = np.zeros(3), np.zeros(3), []
    went = np.array([0.05, 0.0, 0.02])
    for k in range(1, steps):
        # of the motion until here; what it errs by in this sweep is a part of the next one
        truth = se2.compose(truth, went + noise)
        seen = motion.likeliest(observation(k, went, SWEEP_COV), no_fit)
        motion.predict(state, seen)
        noise = rng.multivariate_normal(np.zeros(3), SWEEP_COV)
        found = se2.compose(truth, 0.5 * noise) + rng.multivariate_normal(np.zeros(3), MATCH_COV)
        sweep = motion.sweep if is_used else Sweep()
        information = np.linalg.inv(MATCH_COV)
        match = Found(found, information, NOTHING, information)
        fuse(state.x, state.P, match, 30.0, sweep.half, sweep.velocity)
        motion.corrected(state, seen)
        e = se2.between(truth, state.pose)
        P = se2.rotate_cov(state.pose_cov, -truth[2])
        out.append((*e, e @ np.linalg.solve(P, e)))
    return np.array(out)[10:, :3], np.array(out)[10:, 3]


def test_pose_from_deskewed_scans_is_honest_and_better():
    rng = np.random.default_rng(3)
    runs = [estimate(rng, is_used=True) for _ in range(20)]
    before = [estimate(rng, is_used=False) for _ in range(20)]
    means = [float(np.mean(n)) for _, n in runs]
    # a mean over 20 drives of 49 poses, of which neighbours hang together a little
    assert 2.4 < np.mean(means) < 3.6
    assert np.mean([np.mean(n) for _, n in before]) > 10.0
    turn, turn_before = (np.concatenate([e[:, 2] for e, _ in r]) for r in (runs, before))
    assert np.std(turn) < 0.8 * np.std(turn_before)


def test_error_of_a_sweep_moves_the_pose_as_a_linear_map():
    state, heading = made(spread=0.3), 0.7
    F = np.eye(len(state.x))
    F[:3, MOVING] = se2.rotation3(heading)
    x, P = F @ state.x, F @ state.P @ F.T
    end_sweep(state.x, state.P, heading)
    np.testing.assert_allclose(state.x, x, atol=1e-12)
    np.testing.assert_allclose(state.P, P, atol=1e-12)


def follow(*observations, is_asked=True):
    """State and motion after matches of the first scan, and the other observations."""
    state, motion = JointState(np.zeros(3), 1e-6 * np.eye(3), 0.0), MotionTerm(Parameters())
    for k, one in enumerate(observations):
        if is_asked or not k:
            one = motion.likeliest(one, no_fit)
        motion.predict(state, one)
        if not k:
            sweep, W = motion.sweep, np.linalg.inv(MATCH_COV)
            found = np.array([0.002, 0.0, 0.004])
            match = Found(found, W, NOTHING, W)
            fuse(state.x, state.P, match, 30.0, sweep.half, sweep.velocity)
    return state, motion


def test_next_motion_has_what_the_match_has_shown_of_the_sweep():
    first, second = (observation(k, np.zeros(3), SWEEP_COV) for k in (1, 2))
    before, _ = follow(first)
    assert (before.velocity[[0, 2]] > 1e-4).all()
    state, motion = follow(first, second)
    np.testing.assert_allclose(state.pose, before.pose + before.velocity, atol=1e-5)
    assert motion.sweep.half.all()
    np.testing.assert_allclose(state.P[MOVING, MOVING], SWEEP_COV)


@pytest.mark.parametrize('case', ['other source', 'unknown', 'within the sweep'])
def test_sweep_that_is_not_all_in_the_next_motion_is_left_out(case):
    first, second = (observation(k, np.zeros(3), SWEEP_COV) for k in (1, 2))
    second = replace(second, scan=None)
    if case == 'unknown':
        second = replace(second, motion=replace(second.motion, known=False))
    elif case == 'within the sweep':  # reflectors, or another laser
        second = replace(second, stamp=STEP + STEP // 2)
    before, _ = follow(first)
    state, motion = follow(first, second, is_asked=case != 'other source')
    np.testing.assert_allclose(state.pose, before.pose)
    assert not motion.sweep.half.any()
    assert not state.P[MOVING].any()
    assert np.linalg.eigvalsh(state.P[:3, :3])[0] > 0.0
    # nor is a part of its noise left out
    grown = np.diag(state.pose_cov) - np.diag(before.pose_cov)
    assert (grown > 0.99 * np.diag(SWEEP_COV)).all()


def test_noise_that_is_not_even_over_the_sweep_keeps_the_covariance_positive():
    # the robot starts to drive: of the motion to the next scan, less is known to be uncertain
    first = observation(1, np.zeros(3), SWEEP_COV)
    state, _ = follow(first, observation(2, np.zeros(3), 0.01 * SWEEP_COV))
    assert np.linalg.eigvalsh(state.P)[0] > -1e-15


@pytest.mark.parametrize('what', ['odometry ends in the sweep', 'no ray times', 'no odometry'])
def test_scan_without_a_known_sweep_is_matched_where_its_stamp_is(what):
    one = observation(1, np.zeros(3), SWEEP_COV)
    if what == 'odometry ends in the sweep':
        one = replace(one, sweep_cov=None)
    elif what == 'no ray times':
        one = replace(one, scan=replace(one.scan, time_increment=0.0))
    else:
        one = replace(one, motion=replace(one.motion, known=False))
    state, motion = follow(one)
    assert not motion.sweep.half.any()
    assert not state.velocity.any()


def test_sweep_that_odometry_does_not_cover_has_no_covariance():
    assembly, second = ObservationAssembly(Parameters(), InputCounts()), 10**9
    for k in range(40):
        assembly.buffer.add_odometry(
            Odometry(second + k * second // 50, np.array([0.01 * k, 0, 0]))
        )
    covered, late = second + second // 2, second + 39 * second // 50 - STEP // 2
    for stamp, is_covered in ((covered, True), (late, False)):
        group = [Waiting(stamp, 'scan', scan(stamp), 0)]
        found = assembly.assemble(stamp, group, (0.0, 0.0))
        assert (found.sweep_cov is not None) == is_covered


def test_new_reflectors_keep_what_the_pose_has_of_the_sweep():
    state = made(landmarks=2)
    A = 0.1 * np.random.default_rng(4).standard_normal((7, 7))
    cov = A @ A.T + 1e-3 * np.eye(7)
    part = np.linalg.solve(state.P[:3, :3], state.P[:3, MOVING]).T
    rest = state.P[MOVING, MOVING] - part @ state.P[:3, MOVING]
    state.replace(np.ones((2, 2)), cov, np.zeros((3, 3)))
    rows = np.r_[0:3, LANDMARKS : LANDMARKS + 4]
    np.testing.assert_allclose(state.P[MOVING, rows], part @ cov[:3], atol=1e-12)
    after = state.P[MOVING, MOVING] - part @ state.P[:3, MOVING]
    np.testing.assert_allclose(after, rest, atol=1e-12)
    assert np.linalg.eigvalsh(state.P)[0] > -1e-12
