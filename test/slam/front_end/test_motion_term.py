# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from differences import central_differences
from made_worlds import SECOND, STEP

from rlml_slam import se2
from rlml_slam.motion import STILL, compose_motion
from rlml_slam.params import MotionNoise, Parameters, from_mapping
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end.joint_state import (
    PIVOT,
    SPEED,
    WHEELS,
    JointState,
    narrow_scale_errors,
    predict_unseen,
)
from rlml_slam.slam.front_end.motion_term import MotionTerm, expected_motion
from rlml_slam.types import Motion, Observation, Reflectors

NOISE = MotionNoise()
OTHERS = (NOISE.drift_sigma, NOISE.pivot_sigma)
ERRORS = (*NOISE.scale_error_sigma, *OTHERS)
WITHOUT_LIDAR = (*NOISE.first_scale_errors, NOISE.drift_sigma, 0.0)
SIGMA = np.array([0.01, 0.01, 0.001])  # of a pose that is measured
DT = STEP / SECOND
SCAN = np.array([[1.0, 0.0], [-1.0, 0.0]])  # points all around


def measured(rng, shares, v, w):
    """A step at ``v`` [m/s] and ``w`` [rad/s] by odometry that errs by these shares."""
    sigma_v = NOISE.speed_noise * v + NOISE.speed_noise_floor
    sigma_w = NOISE.turn_noise * abs(w) + NOISE.turn_noise_floor
    sigma = np.array([sigma_v, sigma_w]) * DT
    wheels = np.array([v, w - shares[2] * v]) / (1.0 + shares[:2])
    way, turn = wheels * DT + sigma * rng.standard_normal(2)
    delta = np.array([way * np.cos(0.5 * turn), way * np.sin(0.5 * turn), turn])
    by_heading = np.array([-0.5 * delta[1], 0.5 * delta[0], 1.0])  # of the end of an arc
    cov = np.diag([sigma[0], 1e-4, 0.0]) ** 2
    cov += sigma[1] ** 2 * np.outer(by_heading, by_heading)
    return Motion(delta, cov, turn_gain=turn * by_heading, drift_gain=way * by_heading)


def moved(shares, v, w, dt=DT):
    """How the base moves (3,) in a step; it is ahead of the middle of the axle."""
    ahead = np.array([shares[3], 0.0, 0.0])
    axle = se2.exp(np.array([v, 0.0, w]) * dt)
    return se2.compose(se2.compose(-ahead, axle), ahead)


def varied(rng, shares, kept, sigmas=ERRORS):
    """The shares some time later."""
    return kept * shares + np.sqrt(1.0 - kept**2) * np.array(sigmas) * rng.standard_normal(4)


def drive(rng, shares, steps, turning=0.6):
    """Estimates, covariances and truth of the shares, of a robot that sees where it is.

    It goes at 1 m/s and turns at ``turning`` [rad/s], to the left and to the right by turns.
    """
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0, wheels=ERRORS)
    pose, velocity, kept = np.zeros(3), np.zeros(3), np.exp(-DT / NOISE.scale_error_time)
    shares = np.array(shares)
    for k in range(steps):
        v, w = 1.0, turning * (-1.0) ** (k // 100)
        pose = se2.compose(pose, moved(shares, v, w))
        motion = measured(rng, shares, v, w)
        before = state.pose
        state.predict(motion, 0.0, kept, expected_motion(velocity, DT, NOISE))
        z = pose + SIGMA * rng.standard_normal(3)
        error = z - state.pose
        error[2] = se2.wrapped(error[2])
        state.apply(np.arange(3), np.eye(3), np.diag(SIGMA**2), error)
        velocity = se2.log(se2.between(before, state.pose)) / DT
        shares = varied(rng, shares, kept)
    return state.x[WHEELS], state.P[WHEELS, WHEELS], shares


def test_worn_wheels_are_found_out():
    rng = np.random.default_rng(0)
    drives = [drive(rng, (0.04, -0.05, 0.04, 0.15), 800) for _ in range(8)]
    error = np.mean([x - true for x, _, true in drives], axis=0)
    sigma = np.sqrt(np.mean([np.diag(P) for _, P, _ in drives], axis=0))
    assert (sigma < 0.5 * np.array(ERRORS)).all()
    # a mean of eight: four sigmas of it
    assert (np.abs(error) < 4.0 * sigma / np.sqrt(8.0)).all()


def test_shares_are_as_sure_as_they_are_said_to_be():
    rng = np.random.default_rng(1)
    runs = 60
    nees = []
    for _ in range(runs):
        x, P, true = drive(rng, rng.normal(0.0, ERRORS), 300)
        e = x - true
        nees.append(e @ np.linalg.solve(P, e))
    # chi-square of 4 degrees of freedom: a mean of 4, the sigma of which is sqrt(8 / runs)
    assert np.mean(nees) == pytest.approx(4.0, abs=4.0 * np.sqrt(8.0 / runs))


def test_noise_of_the_wheels_is_not_taken_for_a_share():
    # with the measured motion as the derivative, the share of turn comes to -0.4 here
    x, P, _ = drive(np.random.default_rng(2), (0.0, 0.0, 0.0, 0.0), 2000, turning=0.0)
    assert abs(x[1]) < 0.01
    assert P[1, 1] == pytest.approx(NOISE.scale_error_sigma[1] ** 2, rel=0.02)


def with_lidar(rng, shares, speeds, late=0.0, dt=0.2, sigma=SIGMA, new_submap=0, bridged=0):
    """Errors (4,) of what the wheels err by and their sigmas, of a robot with a lidar.

    ``speeds`` (n, 2) [m/s, rad/s] are those of each second; its odometry is ``late`` [s] and errs
    by ``shares``. ``sigma`` (3,) is that of a pose, in whose direction nothing is seen where it is
    inf. A submap begins after ``new_submap`` steps each; after ``bridged`` steps each, another
    source says how the robot moved.
    """
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0, wheels=ERRORS)
    term, pose = MotionTerm(Parameters()), np.zeros(3)
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(speeds, axis=0)])
    seen = np.isfinite(sigma)
    rows, H = np.flatnonzero(seen), np.eye(3)[seen][:, seen]

    def until(t):  # way and turn
        return sums[int(t)] + (t - int(t)) * speeds[int(t)]

    for k in range(int((len(speeds) - 2) / dt)):
        t = 1.0 + k * dt
        v, w = (until(t + dt) - until(t)) / dt
        pose = se2.compose(pose, moved(shares, v, w, dt))
        noise = np.array([NOISE.speed_noise * v, NOISE.turn_noise * abs(w)])
        noise += NOISE.speed_noise_floor, NOISE.turn_noise_floor
        noise *= np.sqrt(NOISE.noise_interval * dt)
        wheels = until(t + dt - late) - until(t - late)
        wheels = (wheels - [0.0, shares[2] * wheels[0]]) / (1.0 + np.array(shares[:2]))
        way, turn = wheels + noise * rng.standard_normal(2)
        delta = np.array([way * np.cos(0.5 * turn), way * np.sin(0.5 * turn), turn])
        by_heading = np.array([-0.5 * delta[1], 0.5 * delta[0], 1.0])
        cov = np.diag([noise[0], 0.01, 0.0]) ** 2
        cov += noise[1] ** 2 * np.outer(by_heading, by_heading)
        motion = Motion(delta, cov, turn_gain=turn * by_heading, drift_gain=way * by_heading)
        o = Observation(int(k * dt * SECOND), motion, SCAN, np.zeros(2), odom_pose=np.zeros(3))
        o = term.likeliest(o, lambda _: None)
        if bridged and k % bridged == 0:
            o = replace(o, motion=replace(o.motion, delta=delta.copy()))
        term.predict(state, o)
        error = pose - state.pose
        error[seen] += sigma[seen] * rng.standard_normal(len(rows))
        error[2] = se2.wrapped(error[2])
        state.apply(rows, H, np.diag(sigma[seen] ** 2), error[seen])
        term.corrected(state, o)
        if new_submap and k % new_submap == 0:
            state.clone_pose(0, 0.0, 1e-6 * np.eye(3))
    return state.x[WHEELS] - shares, np.sqrt(np.diag(state.P[WHEELS, WHEELS]))


def stop_and_go(rng, steps=200):
    """Speeds of a robot that begins and ends to drive and to turn all the time."""
    return np.stack([rng.integers(0, 3, steps) / 2.0, 0.8 * rng.integers(-1, 2, steps)], -1)


@pytest.mark.parametrize('late', [0.03, 0.0, -0.03])
def test_odometry_that_is_late_has_no_scale_error(late):
    """Taken from single steps, the error of the turn is .15 with a sigma of .015."""
    generators = [np.random.default_rng(k) for k in range(5)]
    drives = [
        with_lidar(rng, (0.02, -0.05, 0.0, 0.05), stop_and_go(rng), late) for rng in generators
    ]
    error, sigma = (np.array(part)[:, :2] for part in zip(*drives, strict=True))
    assert (sigma < [0.012, 0.03]).all()
    assert (np.abs(error).mean(axis=0) < sigma.mean(axis=0)).all()
    assert (np.abs(error) < 3.0 * sigma).all()


@pytest.mark.parametrize('turning', [0.5, -0.5])
def test_scale_error_and_drift_of_one_curve_are_not_separated(turning):
    speeds, errors = np.tile([0.8, turning], (32, 1)), []
    for k in range(40):
        rng = np.random.default_rng(k)
        error, sigma = with_lidar(rng, ERRORS * rng.standard_normal(4), speeds)
        errors.append(error / sigma)
    assert (np.mean(np.square(errors), axis=0) < 1.6).all()  # p = .01 each


def test_a_new_submap_measures_no_scale_error():
    """Along a corridor without an end, the pose in a submap that begins there is sure at once."""
    sigma = np.array([np.inf, 0.01, 0.001])
    rng, speeds = np.random.default_rng(0), np.tile([0.8, 0.0], (102, 1))
    _, found = with_lidar(rng, (0.04, 0.0, 0.0, 0.0), speeds, sigma=sigma, new_submap=25)
    assert found[0] > 0.95 * ERRORS[0]


def test_a_stall_that_is_bridged_measures_no_scale_error():
    rng, speeds = np.random.default_rng(0), np.tile([0.8, 0.2], (102, 1))
    _, found = with_lidar(rng, (0.04, 0.0, 0.0, 0.0), speeds, bridged=10)
    np.testing.assert_allclose(found[:2], ERRORS[:2], rtol=1e-9)


def test_from_the_first_scan_on_the_wheels_err_less():
    """Until then only odometry leads from one reflector to the next."""
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0, wheels=WITHOUT_LIDAR)
    term = MotionTerm(Parameters())
    standing = Motion(np.zeros(3), 1e-8 * np.eye(3))
    term.predict(state, Observation(0, standing, odom_pose=np.zeros(3)))
    np.testing.assert_allclose(np.sqrt(np.diag(state.P)[WHEELS]), WITHOUT_LIDAR)

    term.predict(state, Observation(STEP, standing, SCAN, np.zeros(2), odom_pose=np.zeros(3)))
    np.testing.assert_allclose(np.sqrt(np.diag(state.P)[WHEELS]), ERRORS)
    for k in range(2, 100):  # as wide as it becomes
        term.predict(state, Observation(k * 60 * SECOND, standing, odom_pose=np.zeros(3)))
    np.testing.assert_allclose(np.sqrt(np.diag(state.P)[WHEELS]), ERRORS, rtol=1e-6)


def test_larger_errors_with_a_lidar_hold_without_one_too():
    p = from_mapping({'motion.scale_error_sigma': (0.2, 0.3)}, Parameters)
    assert p.motion.first_scale_errors == (0.2, 0.3)
    np.testing.assert_allclose(np.sqrt(FrontEnd(p).state.wheels2), (0.2, 0.3, *WITHOUT_LIDAR[2:]))


def test_a_front_end_that_begins_again_has_not_seen_its_lidar():
    front_end = FrontEnd(Parameters())
    np.testing.assert_allclose(np.sqrt(front_end.state.wheels2), WITHOUT_LIDAR)
    front_end.process(Observation(0, STILL, SCAN, np.zeros(2), odom_pose=np.zeros(3)))
    np.testing.assert_allclose(np.sqrt(front_end.state.wheels2), ERRORS)
    front_end.reset(np.zeros(3), np.zeros((3, 3)))
    np.testing.assert_allclose(np.sqrt(front_end.state.wheels2), WITHOUT_LIDAR)


@pytest.mark.parametrize('turn', [NOISE.scale_error_sigma[1], 0.0])
def test_relocation_in_a_saved_map_keeps_what_is_known_of_the_wheels(turn):
    """The scan that follows replaces no prior for the second time."""
    p = from_mapping({'motion.scale_error_sigma': (0.03, turn)}, Parameters)
    front_end = FrontEnd(p)
    seen = np.zeros(1, dtype=np.int64)
    cov = 1e-4 * np.eye(2)[None]
    front_end.use_map(Reflectors(seen, np.array([[3.0, 1.0]]), cov, seen, seen, np.zeros(1)))

    def scan(k):
        still = Observation(k * STEP, STILL, SCAN, np.zeros(2), odom_pose=np.zeros(3))
        front_end.process(still)
        return front_end.state.x[WHEELS].copy(), front_end.state.P[WHEELS, WHEELS].copy()

    scan(0)
    front_end.state.x[SPEED + 1] = turn
    before = scan(1)
    front_end.relocate(np.array([1.0, 1.0, 0.0]), 1e-2 * np.eye(3))
    for value, expected in zip(scan(2), before, strict=True):
        np.testing.assert_allclose(value, expected, rtol=0.01, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(front_end.state.wheels2), (0.03, turn, *OTHERS))


@pytest.mark.parametrize('sigmas', [NOISE.scale_error_sigma, (0.01, 0.02), (0.0, 0.0), (0.3, 0.4)])
def test_a_narrower_prior_is_as_if_it_had_been_there_from_the_start(sigmas):
    """To mean and covariance, with all that was measured before, where nothing varied."""
    rng = np.random.default_rng(3)
    wide = np.array(WITHOUT_LIDAR[:2])
    H, measured = rng.normal(size=(5, 2)), 0.02 * rng.normal(size=5)
    states = []
    for prior in (wide, np.minimum(wide, sigmas)):
        state = JointState(np.zeros(3), 0.01 * np.eye(3), 0.0, wheels=(*prior, 0.03, 0.1))
        columns = np.array([0, 1, SPEED, SPEED + 1])
        J = np.hstack([np.ones((5, 2)), H])
        state.apply(columns, J, 1e-3 * np.eye(5), measured)
        states.append(state)
    assert abs(states[0].x[WHEELS]).max() > 1e-3
    narrow_scale_errors(states[0], sigmas)
    np.testing.assert_allclose(states[0].x, states[1].x, atol=1e-12)
    np.testing.assert_allclose(states[0].P, states[1].P, atol=1e-12)
    np.testing.assert_allclose(states[0].wheels2, states[1].wheels2)


def test_where_the_robot_turns_moves_the_pose_as_a_linear_map():
    """Of base, turn and heading, by central differences; the way back is of the same size."""
    measured = np.array([0.0, 0.0, 0.7])
    motion = Motion(np.array([0.3, 0.02, 0.7]), 1e-6 * np.eye(3), turn_gain=measured)

    def after(ahead, heading=0.4):
        state = JointState(np.array([1.0, -2.0, heading]), np.diag([0.0, 0.0, 1e-4]), 0.0)
        state.x[PIVOT], state.P[PIVOT, PIVOT] = ahead, 0.01
        state.predict(motion, 0.0, 1.0, motion.delta[[0, 2]])
        return state

    def pose(v):
        return after(v[0], v[1]).pose

    at = np.array([0.2, 0.4])
    expected = se2.compose(np.array([1.0, -2.0, 0.4]), se2.compose(motion.delta, [0.2, 0.0, 0.0]))
    expected -= [0.2 * np.cos(0.4), 0.2 * np.sin(0.4), 0.0]
    state = after(*at)
    np.testing.assert_allclose(state.pose, expected, atol=1e-12)
    J = central_differences(pose, at)
    np.testing.assert_allclose(state.P[:3, PIVOT], 0.01 * J[:, 0], atol=1e-9)
    turned = 1e-4 * np.outer(J[:, 1], J[:, 1]) + 0.01 * np.outer(J[:, 0], J[:, 0])
    np.testing.assert_allclose(state.pose_cov, turned, atol=2e-6)
    back = state.corrected(motion).delta
    there = se2.between(np.array([1.0, -2.0, 0.4]), state.pose)
    np.testing.assert_allclose(back, there, atol=1e-12)


def test_motion_that_nobody_measured_is_that_of_the_base_itself():
    """As it goes on, or by what scans have shown: no gain says that wheels or a gyro turned."""
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0)
    state.x[PIVOT], state.P[PIVOT, PIVOT] = 0.2, 0.01
    motion = Motion(np.array([0.0, 0.02, 0.1]), 1e-6 * np.eye(3), known=False)
    np.testing.assert_allclose(state.corrected(motion).delta, motion.delta, atol=1e-15)
    state.predict(motion, 0.0, 1.0, motion.delta[[0, 2]])
    np.testing.assert_allclose(state.pose, motion.delta, atol=1e-15)
    assert not state.P[:3, PIVOT].any()


@pytest.mark.parametrize('has_lidar', [True, False])
def test_where_the_robot_turns_is_modelled_for_a_lidar(has_lidar):
    front_end = FrontEnd(Parameters())
    angles = np.radians(np.linspace(-45.0, 45.0, 90))
    points = [0.3, 0.1] + 4.0 * np.stack([np.cos(angles), np.sin(angles)], -1)
    seen = points if has_lidar else None
    o = Observation(0, STILL, seen, np.array([0.3, 0.1]), odom_pose=np.zeros(3))
    front_end.process(o)
    sigma = NOISE.pivot_sigma if has_lidar else 0.0
    assert front_end.state.P[PIVOT, PIVOT] == pytest.approx(sigma**2)


def test_base_that_is_not_where_the_robot_turns_is_found_while_it_turns():
    """As is a laser that is mounted elsewhere than the robot's description says."""
    speeds = np.tile([0.0, 0.6], (60, 1))
    for ahead in (0.2, -0.1, 0.0):
        rng = np.random.default_rng(1)
        error, sigma = with_lidar(rng, (0.0, 0.0, 0.0, ahead), speeds)
        assert abs(error[3]) < 3.0 * sigma[3] < 0.05


def test_what_may_be_no_way_at_all_tells_nothing():
    """After a jump of the pose its velocity is none; unseen, a robot may have braked."""
    assert expected_motion(np.array([1.0, 0.0, 0.1]), 0.5, NOISE).all()
    for velocity, dt in (((1.0, 0.0, 0.1), 5.0), ((50.0, 0.0, 0.1), 0.5), ((1.0, 0.0, 50.0), 0.5)):
        assert not expected_motion(np.array(velocity), dt, NOISE).any()


@pytest.mark.parametrize(
    ('v', 'turning', 'steps'), [(0.1, 0.0, 300), (0.2, 0.05, 300), (0.5, 0.2, 100)]
)
def test_way_unseen_is_as_uncertain_as_scale_errors_make_it(v, turning, steps):
    """Up to half a minute between two sightings: much more than the noise of the odometry."""
    rng = np.random.default_rng(4)
    runs, nees, without = 60, [], []
    kept = np.exp(-DT / NOISE.scale_error_time)
    for _ in range(runs):
        shares = rng.normal(0.0, WITHOUT_LIDAR)
        state = JointState(np.zeros(3), 1e-8 * np.eye(3), 0.0, wheels=WITHOUT_LIDAR)
        term, pose, motion = MotionTerm(Parameters()), np.zeros(3), STILL
        term.predict(state, Observation(0, STILL, odom_pose=np.zeros(3)))
        for _ in range(steps):
            pose = se2.compose(pose, moved(shares, v, turning))
            motion = compose_motion(motion, measured(rng, shares, v, turning))
            shares = varied(rng, shares, kept, WITHOUT_LIDAR)
        term.predict(state, Observation(steps * STEP, motion, odom_pose=motion.delta))
        e = pose - state.pose
        e[2] = se2.wrapped(e[2])
        nees.append(e @ np.linalg.solve(state.pose_cov, e))
        without.append(e @ np.linalg.solve(motion.cov, e))
    assert np.mean(nees) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / runs))
    assert np.mean(without) > 7.0


def test_what_the_wheels_err_by_stays_tied_to_where_they_led():
    """A sighting after a long way says what turned the robot."""
    state = JointState(np.zeros(3), 1e-8 * np.eye(3), 0.0, wheels=WITHOUT_LIDAR)
    arc = Motion(np.array([2.0, 1.0, 1.5]), 1e-6 * np.eye(3), turn_gain=np.array([-0.7, 1.0, 1.5]))
    predict_unseen(state, arc, 0.0, 1.0)
    ahead = [np.cos(1.5) - 1.0, np.sin(1.5), 0.0]
    J = np.array([[2.0, 1.0, 0.0], [-0.7, 1.0, 1.5], [0.0, 0.0, 0.0], ahead]).T
    wheels = np.diag(np.square(WITHOUT_LIDAR))
    np.testing.assert_allclose(state.P[:3, WHEELS], J @ wheels, atol=1e-9)
    np.testing.assert_allclose(state.P[:3, :3], J @ wheels @ J.T, atol=2e-6)
    np.testing.assert_allclose(state.P, state.P.T, atol=1e-12)
    error = np.array([1.65 - state.x[2]])  # it turned by a tenth more than its wheels said
    state.apply(np.array([2]), np.eye(1), 1e-8 * np.eye(1), error)
    assert state.x[SPEED + 1] == pytest.approx(0.1, rel=0.01)


def test_a_robot_with_a_lidar_has_it_after_a_relocation_in_a_saved_map():
    front_end, seen = FrontEnd(Parameters()), np.zeros(1, dtype=np.int64)
    cov = 1e-4 * np.eye(2)[None]
    saved = Reflectors(seen, np.array([[3.0, 1.0]]), cov, seen, seen, np.zeros(1))
    front_end.use_map(saved)
    front_end.process(Observation(0, STILL, SCAN, np.zeros(2), odom_pose=np.zeros(3)))
    front_end.relocate(np.array([1.0, 1.0, 0.0]), 1e-2 * np.eye(3))
    assert front_end._motion.has_lidar
