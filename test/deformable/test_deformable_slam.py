# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest

from rlml_lab.carrier.carrier import simulate_carrier
from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_slam.deformable.active import offsets
from rlml_slam.deformable.bridge import bridge
from rlml_slam.deformable.gyro_bias import GyroBias
from rlml_slam.deformable.slam import DeformableSlam
from rlml_slam.deformable.suggest import drivable, suggest_twist
from rlml_slam.deformable.velocity import MAX_KEPT, VelocityHistory
from rlml_slam.deformable.window import CarrierVelocity, DeformableWindow
from rlml_slam.errors import SolverError
from rlml_slam.params import (
    Deformable,
    DeformableParameters,
    MotionNoise,
    Node,
    Parameters,
    Reflector,
)
from rlml_slam.se2 import compose, exp, wrap
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.types import Level, Motion, Observation, Odometry

SECOND = 1_000_000_000
STILL = CarrierVelocity(np.zeros(2))
NOISE_OF_THE_DRIVE = MotionNoise(
    speed_noise=0.0, speed_noise_floor=0.01 / np.sqrt(0.1),
    turn_noise=0.0, turn_noise_floor=0.004 / np.sqrt(0.1), lateral_noise=0.01 / np.sqrt(0.1),
)  # fmt: skip


def steps(count, seed=0, **settings):
    return list(islice(simulate_carrier(Carrier(**settings), seed), count))


def announce(slam, run):
    for before, step in pairwise(run):
        slam.announce(before.stamp, CarrierVelocity(step.linear, step.angular))


def observe(step):
    return Observation(step.stamp, step.motion, detections=step.detections)


def drive(run, params=None):
    slam = DeformableSlam(params or DeformableParameters())
    announce(slam, run)
    return [(slam.process(observe(s)), slam.estimate) for s in run], slam


# --- the carrier's velocity -----------------------------------------------------------------


def test_velocity_holds_until_the_next_one():
    history = VelocityHistory(60.0)
    for stamp, v in ((3, 3.0), (0, 1.0), (1, 2.0), (1, 5.0)):  # out of order; the last one wins
        history.add(stamp * SECOND, CarrierVelocity(np.array([v, -v]), 0.1 * v))
    mean = history.mean(0, 4 * SECOND)  # 1 s at 1, 2 s at 5, 1 s at 3
    np.testing.assert_allclose(mean.linear, [3.5, -3.5])
    assert mean.angular == pytest.approx(0.35)
    np.testing.assert_allclose(history.mean(4 * SECOND, 9 * SECOND).linear, [3.0, -3.0])
    assert history.age(9 * SECOND) == pytest.approx(6.0)


def test_first_velocity_held_before_it_and_none_is_standing_still():
    history = VelocityHistory(1.0)
    assert history.age(5) is None
    np.testing.assert_array_equal(history.mean(0, 5).linear, [0.0, 0.0])
    history.add(10 * SECOND, CarrierVelocity(np.array([1.0, 0.0])))
    early = history.mean(SECOND, 2 * SECOND)
    before = history.mean(9 * SECOND, 10 * SECOND)
    for mean in (early, before):
        np.testing.assert_allclose(mean.linear, [1.0, 0.0])
    assert before.sigma == 0.0
    assert history.age(SECOND) == 0.0


def test_first_velocity_is_unknown_by_its_own_size_long_before_its_stamp():
    history = VelocityHistory(1.0)
    history.add(10 * SECOND, CarrierVelocity(np.array([3.0, 4.0])))
    history.add(11 * SECOND, CarrierVelocity(np.array([1.0, 0.0])))
    assert history.mean(SECOND, 2 * SECOND).sigma == pytest.approx(5.0)
    # 6 of these 8 s are more than a second before the first stamp; the second one is no first
    assert history.mean(3 * SECOND, 11 * SECOND).sigma == pytest.approx(5.0 * 6 / 8)
    assert history.lead(5 * SECOND) == pytest.approx(6.0)


def test_velocity_is_unknown_by_its_own_size_after_the_timeout():
    history = VelocityHistory(1.0)
    history.add(SECOND, CarrierVelocity(np.array([3.0, 4.0])))
    assert history.mean(SECOND, 2 * SECOND).sigma == 0.0
    assert history.mean(SECOND, 5 * SECOND).sigma == pytest.approx(5.0 * 3 / 4)
    assert history.mean(4 * SECOND, 5 * SECOND).sigma == pytest.approx(5.0)
    history.add(9 * SECOND, CarrierVelocity(np.array([1.0, 0.0])))
    # 4 s of silence, 1 s of the new one's first, 1 s after its timeout
    assert history.mean(5 * SECOND, 11 * SECOND).sigma == pytest.approx((5.0 * 4 + 1.0 * 1) / 6)


def test_history_forgets_what_was_used_and_has_a_limit():
    history = VelocityHistory(1.0)
    for k in range(MAX_KEPT + 50):
        history.add(k, STILL)
    assert len(history._stamps) == len(history._velocities) == MAX_KEPT
    history.mean(MAX_KEPT + 40, MAX_KEPT + 45)
    assert history._stamps == list(range(MAX_KEPT + 40, MAX_KEPT + 50))


# --- the gyro -------------------------------------------------------------------------------


def gyro_motion(rate, wheels, dt, variance):
    """Motion as MotionBuffer says it: turn of the gyro, bias as the wheels see it."""
    gain = np.array([0.0, 0.0, -dt])
    return Motion(np.array([0.0, 0.0, rate * dt]), 1e-12 * np.eye(3), True, gain, rate - wheels,
                  variance)  # fmt: skip


def test_heading_error_by_a_biased_gyro_stays_within_its_covariance():
    """Summed over 30 s in 100 runs, the errors are as large as the sum of the variances says."""
    dt, sigma, noise = 0.1, 0.05, MotionNoise()
    errors, variances = [], []
    for seed in range(100):
        g = np.random.default_rng(seed)
        filtered, bias = GyroBias(noise), noise.imu_bias_sigma * g.standard_normal()
        error = variance = 0.0
        for _ in range(300):
            bias += noise.imu_bias_walk * np.sqrt(dt) * g.standard_normal()
            m = gyro_motion(bias, sigma * g.standard_normal(), dt, sigma**2)
            got = filtered.correct(m, dt)
            error += got.delta[2]  # the robot does not turn
            variance += got.cov[2, 2]
        errors.append(error)
        variances.append(variance)
    low, high = chi2_bounds(1, 100)
    assert low < np.mean(np.square(errors) / variances) < high


def test_motion_without_a_gyro_is_left_alone():
    motion = Motion(np.ones(3), np.eye(3))
    assert GyroBias(MotionNoise()).correct(motion, 0.1) is motion


def test_slipping_wheels_do_not_spoil_the_bias():
    filtered = GyroBias(MotionNoise())
    for _ in range(200):
        filtered.correct(gyro_motion(0.01, 0.0, 0.1, 1e-4), 0.1)
    settled = filtered.bias
    filtered.correct(gyro_motion(0.01, 3.0, 0.1, 1e-4), 0.1)
    assert settled == pytest.approx(0.01, rel=0.1)
    assert filtered.bias == settled


# --- the system -----------------------------------------------------------------------------


def test_system_is_the_window_with_motion_and_velocity_of_the_observations():
    run = steps(40)
    answers, _ = drive(run)
    window = DeformableWindow(Deformable(), Reflector())
    for s, (frame, estimate) in zip(run, answers, strict=True):
        expected = window.update(
            s.stamp, s.motion, s.detections, CarrierVelocity(s.linear, s.angular)
        )
        # the motion floor adds 4e-8 to variances of 1e-4
        np.testing.assert_allclose(estimate.pose, expected.pose, atol=1e-5)
        np.testing.assert_array_equal(frame.T_map_base, estimate.pose)
        np.testing.assert_array_equal(frame.landmarks, expected.keys)
    assert frame.health.level is Level.OK


def test_standing_still_beside_a_standing_carrier_is_fine():
    """Odometry of a standing robot may have a covariance of exactly 0."""
    run = [replace(s, motion=Motion(np.zeros(3), np.zeros((3, 3))))
           for s in steps(60, speed=0.0, turn_rate=0.0)]  # fmt: skip
    answers, _ = drive(run)
    assert np.abs(answers[-1][1].pose).max() < 0.01
    assert answers[-1][0].health.level is Level.OK


def test_health_names_what_is_wrong():
    run = steps(60)
    lost = replace(run[-1].motion, known=False)
    run = [replace(s, motion=lost if k == 55 else s.motion) for k, s in enumerate(run)]
    slam = DeformableSlam(DeformableParameters())
    frames = [slam.process(replace(observe(s), detections=None if k >= 40 else s.detections))
              for k, s in enumerate(run)]  # fmt: skip
    assert 'no carrier_velocity yet' in frames[5].health.reasons[0]
    assert 'no feature of the carrier is known' in frames[0].health.reasons
    assert frames[55].health.level is Level.LOST
    assert 'odometry does not cover the motion' in frames[55].health.reasons
    announce(slam, run)
    late = slam.process(Observation(run[-1].stamp + 3 * SECOND, lost))
    assert any(r.startswith('carrier_velocity is 3.') for r in late.health.reasons)


def test_unusable_covariance_costs_the_detections_but_not_the_motion():
    run = steps(30)
    broken = replace(run[-1].detections, cov=np.zeros_like(run[-1].detections.cov))
    answers, slam = drive(run[:-1])
    announce(slam, run)
    frame = slam.process(replace(observe(run[-1]), detections=broken))
    assert frame.health.level is Level.DEGRADED
    assert any('not positive definite' in r for r in frame.health.reasons)
    moved = np.linalg.norm(slam.estimate.pose[:2] - answers[-1][1].pose[:2])
    assert moved == pytest.approx(np.linalg.norm(run[-1].motion.delta[:2]), abs=0.02)


@pytest.mark.parametrize(('ahead', 'level'), [(0.3, Level.OK), (5.0, Level.DEGRADED)])
def test_velocity_stamped_ahead_of_the_clock_is_named(ahead, level):
    """At once and for good: once its stamps are reached, each velocity is used too late."""
    slam, run = DeformableSlam(DeformableParameters()), steps(80)
    lead = round(ahead * SECOND)
    for before, step in pairwise(run):
        slam.announce(before.stamp + lead, CarrierVelocity(step.linear, step.angular))
        frame = slam.process(observe(step))
        if before.stamp > SECOND // 2:
            assert frame.health.level is level
        if level is Level.DEGRADED:
            assert f'carrier_velocity is stamped {ahead - 0.1:.1f} s ahead' in frame.health.reasons


def test_velocity_of_an_hour_ahead_is_as_unknown_as_one_of_an_hour_ago():
    run, ends = steps(60), []
    for lead in (-3600 * SECOND, 3600 * SECOND, 0):
        slam = DeformableSlam(DeformableParameters(deformable=Deformable(velocity_timeout=30.0)))
        slam.announce(lead, CarrierVelocity(run[1].linear, run[1].angular))
        ends.append([slam.process(observe(step)) for step in run][-1].cov_map)
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.all(np.diag(ends[0]) > np.diag(ends[2]))


def test_velocity_in_the_robots_axes_turns_with_the_robot():
    """Announced once, while the robot turns a quarter on the spot."""
    slam = DeformableSlam(DeformableParameters())
    slam.announce(0, CarrierVelocity(np.array([1.0, 0.0])), in_base=True)
    turn = Motion(np.array([0.0, 0.0, np.pi / 2]), 1e-8 * np.eye(3))
    for k in range(3):
        slam.process(Observation(k * SECOND // 10, turn))
    assert slam.velocity.sigma == 0.0
    np.testing.assert_allclose(slam.velocity.linear, [-1.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(slam.velocity.base_linear, [0.0, 0.0])


def test_heading_error_spreads_a_velocity_in_the_robots_axes_across_it():
    """The features of a robot that stands and sees none of them are moved by R(theta) (2, 0)."""
    still, run, after = Motion(np.zeros(3), 1e-8 * np.eye(3)), steps(20), []
    for in_base in (False, True):
        slam = DeformableSlam(DeformableParameters())
        slam.begin_at(np.zeros(3), np.diag([0.0, 0.0, 0.01]))
        for step in run:
            slam.process(Observation(step.stamp, still, detections=run[0].detections))
        before = slam.estimate
        slam.announce(run[-1].stamp, CarrierVelocity(np.array([20.0, 0.0])), in_base)
        slam.process(Observation(run[-1].stamp + SECOND // 10, still))
        after.append(slam.estimate.joint_cov)
    F = np.eye(len(before.joint_cov))
    F[4::2, 2] = 2.0
    grown = F @ before.joint_cov @ F.T - before.joint_cov
    assert np.all(grown[3::2, 2] == 0.0)  # along it, nothing
    np.testing.assert_allclose(after[1] - after[0], grown, rtol=1e-3, atol=1e-4)


def test_velocities_in_the_robots_axes_leave_the_estimate_consistent():
    """12 drives of 30 s: independent samples."""
    errors = []
    for seed in range(12):
        slam = DeformableSlam(DeformableParameters(motion=NOISE_OF_THE_DRIVE))
        run = steps(300, seed, kind='conveyor')
        for before, step in pairwise(run):
            c, s = np.cos(before.pose[2]), np.sin(before.pose[2])
            linear = np.array([[c, s], [-s, c]]) @ step.linear
            slam.announce(before.stamp, CarrierVelocity(linear, step.angular), in_base=True)
            slam.process(observe(before))
        frame = slam.process(observe(run[-1]))
        error = frame.T_map_base - run[-1].pose
        error[2] = wrap(error[2])
        errors.append(error @ np.linalg.solve(frame.cov_map, error))
    low, high = chi2_bounds(3, 12)
    assert low < np.mean(errors) < high


def test_detections_of_very_small_sigma_are_used():
    """1e-12 of the covariance: 10^-8 m, which no arithmetic of the equations stands."""
    run = steps(330, seed=1)
    slam = DeformableSlam(DeformableParameters())
    announce(slam, run)
    for k, s in enumerate(run):
        small = replace(s.detections, cov=1e-12 * s.detections.cov)
        frame = slam.process(replace(observe(s), detections=small))
        assert not any('restarted' in r for r in frame.health.reasons), k
    assert frame.health.level is Level.OK
    assert np.linalg.norm(frame.T_map_base[:2] - run[-1].pose[:2]) < 0.5


def test_update_after_a_restart_does_not_raise(monkeypatch):
    """Where detections make the window unsolvable, twice as well."""
    run, update = steps(30), DeformableWindow.update

    def fail(window, stamp, motion, detections, velocity):
        if len(detections):
            raise SolverError('singular')
        return update(window, stamp, motion, detections, velocity)

    _, slam = drive(run[:-2])
    monkeypatch.setattr(DeformableWindow, 'update', fail)
    for step in run[-2:]:
        frame = slam.process(observe(step))
        assert 'singular: restarted' in frame.health.reasons
        assert np.linalg.norm(frame.T_map_base[:2] - step.pose[:2]) < 0.5


def test_unsolvable_window_begins_anew_where_the_robot_is(monkeypatch):
    run = steps(30)
    answers, slam = drive(run[:-1])

    def fail(*args):
        raise SolverError('singular')

    monkeypatch.setattr(slam._window, 'update', fail)
    frame = slam.process(observe(run[-1]))
    assert frame.health.reasons[0] == 'singular: restarted'
    step = np.linalg.norm(slam.estimate.pose[:2] - answers[-1][1].pose[:2])
    assert step == pytest.approx(np.linalg.norm(run[-1].motion.delta[:2]), abs=1e-6)
    assert np.all(np.diag(frame.cov_map) >= np.diag(answers[-1][1].cov))


def with_gap(kind, seed, gap, ids=True):
    """A drive of 10 s and a ``gap`` of the data at 4 s, as a node hears it; NEES per update."""
    noise = NOISE_OF_THE_DRIVE
    params = DeformableParameters(motion=noise)
    synchronizer = Synchronizer(Parameters(motion=noise, node=params.node))
    slam, wheels, errors = DeformableSlam(params), np.zeros(3), []
    run = steps(round(10 * (10 + gap)) + 1, seed, kind=kind, ids=ids)
    for step, after in pairwise(run):
        wheels = compose(wheels, step.motion.delta)
        if 0.0 <= step.stamp / SECOND - 4.0 < gap:
            continue
        stamp = SECOND + step.stamp
        slam.announce(stamp, CarrierVelocity(after.linear, after.angular))
        ready = synchronizer.add_odometry(Odometry(stamp, wheels))
        ready += synchronizer.add_detections(replace(step.detections, stamp=stamp))
        for observation in ready:
            frame = slam.process(observation)
            if observation.stamp == stamp:
                error = frame.T_map_base - step.pose
                error[2] = wrap(error[2])
                errors.append(error @ np.linalg.solve(frame.cov_map, error))
    return errors, slam


@pytest.mark.parametrize(('kind', 'gap'), [('train', 3.0), ('train', 25.0), ('conveyor', 8.0)])
def test_gap_of_the_data_leaves_the_estimate_consistent(kind, gap):
    """Right after the gap and 6 s later, over 12 drives: independent samples."""
    drives = [with_gap(kind, seed, gap)[0] for seed in range(12)]
    low, high = chi2_bounds(3, 12)
    # what happened in the gap is a guess, and a generous one
    assert np.mean([d[40] for d in drives]) < high
    assert low < np.mean([d[-1] for d in drives]) < high


def test_features_unseen_for_long_are_new_ones_even_where_they_are_seen_again():
    """Nobody knows where the carrier went meanwhile."""
    _, slam = with_gap('train', 0, 4.5)
    assert slam.estimate.features.keys.max() == 5
    _, slam = with_gap('train', 0, 6.0)
    assert slam.estimate.features.keys.min() == 6


def test_bridge_is_what_the_wheels_counted_and_no_more_than_they_can_count():
    unknown = Motion(np.zeros(3), np.diag([0.4, 0.4, 0.1]), known=False)
    start, moved = np.array([3.0, 1.0, 0.7]), np.array([12.0, -4.0, 0.9])
    known = bridge(unknown, start, compose(start, moved), 20.0, MotionNoise())
    np.testing.assert_allclose(known.delta, moved, atol=1e-12)
    assert known.known
    reset = bridge(unknown, start, compose(start, 10.0 * moved), 20.0, MotionNoise())
    lost = bridge(unknown, None, start, 20.0, MotionNoise())
    for motion in (reset, lost):
        assert not motion.known
        np.testing.assert_allclose(motion.cov, np.diag([80.0, 80.0, 0.1]))


def test_unknown_speed_lasts_as_long_as_the_gap():
    """The noise of an unknown speed does not average out as that of a known one does."""
    run = steps(30)
    answers, slam = drive(run[:-1])
    lost = Motion(np.zeros(3), np.diag([0.4, 0.4, 0.1]), known=False)  # 1 m/s, white, for 4 s
    slam.process(Observation(run[28].stamp + 4 * SECOND, lost))
    grown = np.diag(slam.estimate.cov) - np.diag(answers[-1][1].cov)
    np.testing.assert_allclose(grown, [16.0, 16.0, 0.1], rtol=1e-3)


def test_start_pose_is_a_parameter():
    params = DeformableParameters(node=Node(map_start_pose=(3.0, -1.0, 0.5)))
    answers, _ = drive(steps(1), params)
    np.testing.assert_allclose(answers[0][1].pose, [3.0, -1.0, 0.5], atol=1e-6)


# --- suggestions ----------------------------------------------------------------------------


def suggest(**deformable):
    params = DeformableParameters(
        deformable=Deformable(**deformable), reflector=Reflector(max_range=3.0)
    )
    _, slam = drive(steps(20, max_range=3.0, features=4, seed=1), params)
    return suggest_twist(slam.estimate, slam.velocity, params), slam


def test_suggestion_is_the_carriers_velocity_plus_one_of_the_offsets():
    twist, slam = suggest(suggest='omnidirectional')
    c, s = np.cos(slam.estimate.pose[2]), np.sin(slam.estimate.pose[2])
    keep_up = np.array([[c, s], [-s, c]]) @ slam.velocity.linear
    gaps = np.linalg.norm(keep_up + 0.5 * offsets() - twist[:2], axis=-1)
    assert gaps.min() < 1e-9
    assert twist[2] == pytest.approx(slam.velocity.angular)


def test_differential_suggestion_reaches_the_same_place():
    free, _ = suggest(suggest='omnidirectional', plan_step=0.5)
    wheeled, _ = suggest(suggest='differential', plan_step=0.5)
    assert wheeled[1] == 0.0
    np.testing.assert_allclose(exp(wheeled * 0.5)[:2], free[:2] * 0.5, atol=1e-12)


@pytest.mark.parametrize('to', [(1.0, 0.4), (-1.0, 0.4), (-0.3, -0.2), (0.0, 1.0), (2.0, 0.0)])
def test_arc_ends_where_it_should(to):
    v, across, turn = drivable(np.array([*to, 0.7]))
    assert across == 0.0
    assert abs(turn) <= np.pi
    assert v * to[0] >= 0.0  # what lies behind is backed up to
    np.testing.assert_allclose(exp(np.array([v, 0.0, turn]))[:2], to, atol=1e-12)


def test_robot_that_stands_turns_with_its_carrier():
    np.testing.assert_array_equal(drivable(np.array([0.0, 0.0, 0.7])), [0.0, 0.0, 0.7])


def test_nothing_is_suggested_without_features():
    slam = DeformableSlam(DeformableParameters())
    slam.process(observe(steps(1)[0]))
    assert suggest_twist(slam.estimate, slam.velocity, DeformableParameters()) is None
