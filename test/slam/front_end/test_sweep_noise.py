# SPDX-License-Identifier: Apache-2.0
"""What odometry errs by during a sweep is in the match of its scan, and in the next motion."""

from dataclasses import replace

import numpy as np
from made_states import made

from rlml_slam import se2
from rlml_slam.params import MotionNoise, Parameters
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.joint_state import (
    LANDMARKS,
    MOVING,
    VELOCITY,
    JointState,
    end_sweep,
)
from rlml_slam.slam.front_end.motion_term import MotionTerm
from rlml_slam.slam.front_end.scan_update import fuse
from rlml_slam.types import Motion, Observation, Scan

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
        stamp, Motion(delta, cov), scan=scan(stamp), odom_pose=np.zeros(3), sweep=delta,
        sweep_cov=SWEEP_COV,
    )  # fmt: skip


def estimate(rng, is_used, steps=60):
    """Errors (n, 3) and their NEES (n,), of a robot whose scans are de-skewed by its wheels."""
    params = Parameters(motion=SYSTEMATIC_OFF)
    state, motion = JointState(np.zeros(3), np.zeros((3, 3)), 0.0), MotionTerm(params)
    truth, noise, out = np.zeros(3), np.zeros(3), []
    went = np.array([0.05, 0.0, 0.02])
    for k in range(1, steps):
        # of the motion until here; what it errs by in this sweep is a part of the next one
        truth = se2.compose(truth, went + noise)
        (seen,) = motion.hypotheses(observation(k, went, SWEEP_COV))
        motion.predict(state, seen.observation)
        noise = rng.multivariate_normal(np.zeros(3), SWEEP_COV)
        found = se2.compose(truth, 0.5 * noise) + rng.multivariate_normal(np.zeros(3), MATCH_COV)
        sweep = motion.sweep if is_used else Sweep()
        information = np.linalg.inv(MATCH_COV)
        fuse(
            state.x, state.P, found, information, 30.0, NOTHING, information, sweep.half,
            sweep.velocity,
        )  # fmt: skip
        motion.corrected(state, seen.observation)
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
    state = made(spread=0.3)
    n, heading, share = len(state.x), 0.7, 0.4
    turned = se2.rotate_cov(SWEEP_COV, heading)
    F, B = np.eye(n), np.zeros((n, 3))
    F[:3, MOVING] = share * se2.rotation3(heading)
    F[MOVING, MOVING] *= 1.0 - share
    # given the whole, what the two parts of white noise err by is opposite
    B[:3], B[MOVING] = se2.rotation3(heading), -np.eye(3)
    x = F @ state.x
    P = F @ state.P @ F.T + share * (1.0 - share) * (B @ SWEEP_COV @ B.T)
    P[:3, :3] -= share * (1.0 - share) * turned  # comes with the rest of the motion
    end_sweep(state, heading, share, SWEEP_COV)
    np.testing.assert_allclose(state.x, x, atol=1e-12)
    np.testing.assert_allclose(state.P, P, atol=1e-12)


def test_sweep_that_lasts_over_several_observations_adds_up_to_its_noise():
    params = Parameters(motion=SYSTEMATIC_OFF)
    state, motion = JointState(np.zeros(3), np.zeros((3, 3)), 0.0), MotionTerm(params)
    went, part = np.zeros(3), 0.25
    (first,) = motion.hypotheses(observation(1, went, SWEEP_COV))
    motion.predict(state, first.observation)
    motion.corrected(state, first.observation)
    for k in range(4):  # reflectors, seen during the sweep
        stamp = STEP + int((k + 1) * part * STEP)
        seen = Observation(stamp, Motion(went, part * SWEEP_COV), odom_pose=np.zeros(3))
        (seen,) = motion.hypotheses(seen)
        motion.predict(state, seen.observation)
    np.testing.assert_allclose(np.diag(state.pose_cov), 2.0 * np.diag(SWEEP_COV), rtol=0.02)
    assert not state.P[:3, MOVING].any() or np.abs(state.P[:3, MOVING]).max() < 1e-9


def test_motion_of_another_source_does_not_have_the_error_of_the_sweep():
    state, motion = JointState(np.zeros(3), np.zeros((3, 3)), 0.0), MotionTerm(Parameters())
    (first,) = motion.hypotheses(observation(1, np.zeros(3), SWEEP_COV))
    motion.predict(state, first.observation)
    state.P[:3, VELOCITY] = state.P[VELOCITY, :3] = 1e-6
    other = observation(2, np.full(3, 0.01), SWEEP_COV)  # it was not asked for hypotheses
    motion.predict(state, replace(other, scan=None))
    assert not state.P[MOVING].any()
    assert not motion.sweep.half.any()


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
