# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.motion import motion_of
from rlml_slam.params import Parameters
from rlml_slam.slam.front_end.motion_hypotheses import MotionHypotheses
from rlml_slam.types import Motion, Observation

PARAMS = Parameters()
DT = 0.2
TWIST = np.array([0.85, 0.0, 1.0])
STEP = se2.exp(TWIST * DT)


class Drive:
    """A robot that turns at a constant velocity; its odometry says what the test wants."""

    def __init__(self):
        self.hypotheses = MotionHypotheses(PARAMS)
        self.stamp, self.pose, self.odometry = 10**9, np.zeros(3), np.zeros(3)
        self.hypotheses.learn(self.observation(np.zeros(3)), self.pose)

    def observation(self, delta, known=True):
        motion = motion_of(delta, DT, PARAMS.motion)
        motion = Motion(motion.delta, motion.cov, known)
        return Observation(self.stamp, motion, odom_pose=self.odometry if known else None)

    def go(self, odometry=None, known=True, moved=STEP):
        """The hypotheses of one step; ``odometry`` is what it measured, all of it by default."""
        odometry = STEP if odometry is None else odometry
        self.stamp += round(DT * 1e9)
        self.odometry = se2.compose(self.odometry, odometry)
        seen = self.observation(odometry, known)
        found = self.hypotheses.of(seen, TWIST)
        self.pose = se2.compose(self.pose, moved)
        self.hypotheses.learn(seen, self.pose)
        return [h.observation.motion.delta for h in found]


def test_odometry_that_agrees_is_the_only_hypothesis():
    drive = Drive()
    for _ in range(5):
        found = drive.go()
        assert len(found) == 1
        np.testing.assert_array_equal(found[0], STEP)


def test_odometry_that_stands_while_the_robot_drives_is_doubted():
    drive = Drive()
    drive.go()
    found = drive.go(np.zeros(3))
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_allclose(found[-1], STEP, atol=1e-9)


@pytest.mark.parametrize('dt', [0.03, 0.08])
def test_odometry_that_stands_in_a_slow_turn_is_doubted_at_once(dt):
    twist, still = np.array([0.0, 0.0, 0.6]), np.zeros(3)
    hypotheses, odometry = MotionHypotheses(PARAMS), np.array([1.0, 2.0, 0.3])
    first = Observation(10**9, motion_of(still, dt, PARAMS.motion), odom_pose=odometry)
    hypotheses.learn(first, still)
    stamp = 10**9 + round(dt * 1e9)
    stalled = Observation(stamp, motion_of(still, dt, PARAMS.motion), odom_pose=odometry)
    found = [h.observation.motion.delta for h in hypotheses.of(stalled, twist)]
    np.testing.assert_allclose(found, [still, se2.exp(twist * dt)], atol=1e-9)


@pytest.mark.parametrize('known', [True, False], ids=['stands still', 'is missing'])
def test_step_after_a_stall_is_compared_with_what_scans_have_shown(known):
    drive = Drive()
    drive.go()
    for _ in range(4):
        drive.go(np.zeros(3), known)
    step = se2.exp(TWIST * 5 * DT)
    plain, since, *_ = drive.go(step)
    np.testing.assert_allclose(plain, step)
    np.testing.assert_allclose(since, STEP, atol=1e-9)
    assert len(drive.go()) == 1  # odometry is trusted again


def test_odometry_that_lost_a_stall_is_right_since_then():
    drive = Drive()
    drive.go()
    for _ in range(4):
        drive.go(np.zeros(3))
    np.testing.assert_array_equal(drive.go()[0], STEP)
    drive.go()
    assert len(drive.go()) == 1  # two frames have confirmed it


def test_odometry_after_a_long_gap_counts_from_where_it_was_trusted():
    """Scans went on for a moment after the odometry, then all was missing for ten seconds."""
    drive = Drive()
    drive.go()
    drive.go(known=False)
    step = se2.exp(np.array([2.0, 0.5, 1.2]))
    drive.odometry = se2.compose(drive.odometry, step)
    drive.stamp += 10**10
    unknown = Motion(np.zeros(3), np.eye(3), known=False)
    seen = Observation(drive.stamp, unknown, odom_pose=drive.odometry)
    plain, since = (h.observation.motion for h in drive.hypotheses.of(seen, TWIST))
    assert plain is unknown
    np.testing.assert_allclose(since.delta, step, atol=1e-9)
    assert (np.sqrt(np.diag(since.cov)) < 1.0).all()


@pytest.mark.parametrize(('wrong', 'hypotheses'), [(0.05, 1), (1.6, 2)])
def test_gyro_that_disagrees_with_the_wheels_is_doubted(wrong, hypotheses):
    drive = Drive()
    drive.go()
    drive.stamp += round(DT * 1e9)
    drive.odometry = se2.compose(drive.odometry, STEP)
    by_gyro = se2.exp((TWIST + np.array([0.0, 0.0, wrong / DT])) * DT)
    motion = Motion(by_gyro, 1e-4 * np.eye(3), True)
    seen = Observation(drive.stamp, motion, odom_pose=drive.odometry)
    found = [h.observation.motion.delta for h in drive.hypotheses.of(seen, None)]
    assert len(found) == hypotheses
    np.testing.assert_allclose(found[0], by_gyro)
    np.testing.assert_allclose(found[1:], [STEP] * (hypotheses - 1), atol=1e-9)


def test_robot_that_stops_has_stopped():
    drive = Drive()
    drive.go()
    first = drive.go(np.zeros(3), moved=np.zeros(3))
    assert len(first) == 2  # scans have to say that it does not go on
    drive.hypotheses.learn(drive.observation(np.zeros(3)), drive.pose)
    drive.stamp += round(DT * 1e9)
    assert len(drive.hypotheses.of(drive.observation(np.zeros(3)), np.zeros(3))) == 1


def test_pose_that_was_moved_is_not_compared_with_the_one_before():
    drive = Drive()
    drive.go()
    drive.hypotheses.forget()
    assert len(drive.go(np.zeros(3))) == 1


class Corridor:
    """A robot that drives .9 m/s in a bare corridor, where the scan fits wherever it is."""

    def __init__(self):
        self.hypotheses, self.velocity = MotionHypotheses(PARAMS), np.zeros(3)
        self.stamp, self.true, self.odometry, self.pose = 10**9, 0.0, 0.0, np.zeros(3)
        self.var = 0.0

    def go(self, way, measured):
        self.true, self.odometry = self.true + way, self.odometry + measured
        motion = motion_of(np.array([measured, 0.0, 0.0]), DT, PARAMS.motion)
        self.stamp += round(DT * 1e9)
        seen = Observation(self.stamp, motion, odom_pose=np.array([self.odometry, 0.0, 0.0]))
        chosen = self.hypotheses.likeliest(seen, self.velocity, self.fit)
        self.hypotheses.learn(chosen, se2.compose(self.pose, chosen.motion.delta))
        self.pose = se2.compose(self.pose, chosen.motion.delta)
        self.velocity, self.var = chosen.motion.delta / DT, self.var + chosen.motion.cov[0, 0]

    def fit(self, observation):
        return 0.7, se2.compose(self.pose, observation.motion.delta)

    @property
    def error(self):
        return self.pose[0] - self.true


@pytest.mark.parametrize('lasts', [0.4, 0.8, 1.6])
def test_stall_in_a_bare_corridor_is_made_good_when_the_odometry_catches_up(lasts):
    drive, step = Corridor(), 0.9 * DT
    for _ in range(10):
        drive.go(step, step)
    for _ in range(round(lasts / DT)):
        drive.go(step, 0.0)
    assert drive.error < -0.3  # nothing says that it drove on
    assert drive.var < 0.1  # nor is the doubt of each frame another one
    drive.go(step, step + lasts * 0.9)
    for _ in range(5):
        drive.go(step, step)
    assert abs(drive.error) < 0.03


def test_robot_that_starts_fast_in_a_bare_corridor_does_not_stand_for_ever():
    drive = Corridor()
    for _ in range(5):
        drive.go(0.0, 0.0)
    for _ in range(10):
        drive.go(0.3, 0.3)
    assert abs(drive.error) < 0.01


@pytest.mark.parametrize(('lasts', 'acceleration'), [(4, 1.0), (8, 0.5), (8, 1.0)])
def test_robot_that_starts_during_a_stall_is_where_the_odometry_says(lasts, acceleration):
    drive, way = Corridor(), 0.0
    for _ in range(5):
        drive.go(0.0, 0.0)
    for k in range(lasts):
        step = min(acceleration * (k + 1) * DT, 0.9) * DT
        drive.go(step, 0.0)
        way += step
    drive.go(0.9 * DT, way + 0.9 * DT)
    for _ in range(20):
        drive.go(0.9 * DT, 0.9 * DT)
    assert abs(drive.error) < 0.03


@pytest.mark.parametrize(('frames', 'pause'), [(30, DT), (1, 30.0)], ids=['frames', 'a gap'])
def test_guess_ends_where_the_odometry_goes_missing(frames, pause):
    drive, step = Corridor(), 0.9 * DT
    for k in range(16):
        drive.go(step, step if k < 10 else 0.0)
    assert drive.hypotheses._is_guessed
    for _ in range(frames):
        drive.stamp += round(pause * 1e9)
        unknown = Observation(drive.stamp, Motion(np.zeros(3), np.eye(3), known=False))
        chosen = drive.hypotheses.likeliest(unknown, drive.velocity, drive.fit)
        drive.hypotheses.learn(chosen, drive.pose)
    assert not drive.hypotheses._is_guessed


def test_scan_that_fits_at_one_place_says_how_fast_the_robot_goes_on_during_a_stall():
    drive, step = Corridor(), 0.9 * DT
    drive.fit = lambda observation: (0.7, np.array([drive.true, 0.0, 0.0]))
    for k in range(20):
        drive.go(step, step if k < 10 else 0.0)
        drive.pose[0] = drive.true
        drive.velocity = np.array([0.9, 0.0, 0.0])
    seen = Observation(
        drive.stamp + round(DT * 1e9), motion_of(np.zeros(3), DT, PARAMS.motion),
        odom_pose=np.array([drive.odometry, 0.0, 0.0]),
    )  # fmt: skip
    found = [h.observation.motion.delta[0] for h in drive.hypotheses.of(seen, drive.velocity)]
    np.testing.assert_allclose(found[-1], step, atol=1e-6)
