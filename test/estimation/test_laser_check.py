# SPDX-License-Identifier: Apache-2.0
"""A laser that is mounted otherwise than its transform says is found by odometry."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.estimation.laser_check import LaserCheck
from rlml_slam.types import Motion

FRAME = 100_000_000  # [ns]
STEP = np.array([0.1, 0.0, 0.0])
MIRROR = np.array([1.0, -1.0, -1.0])


def fault_of(steps, seen, known=True):
    """The fault after poses that move by ``seen(step)`` where odometry measures ``step``."""
    check, pose = LaserCheck(), np.zeros(3)
    check.fault(pose)
    for k, step in enumerate(steps):
        check.add_motion((k + 1) * FRAME, Motion(np.array(step), 1e-4 * np.eye(3), known))
        pose = se2.compose(pose, seen(np.array(step)))
        found = check.fault(pose)
    return found


def curve(n):
    return [(0.1, 0.0, 0.05 * np.sin(k / 15.0)) for k in range(n)]


@pytest.mark.parametrize('angle', [90.0, 180.0, -120.0])
def test_pose_that_moves_elsewhere_than_odometry_is_a_fault_after_three_metres(angle):
    def turned(step):
        mounting = np.array([0.0, 0.0, np.radians(angle)])
        return se2.compose(se2.compose(mounting, step), se2.inverse(mounting))

    assert fault_of([STEP] * 25, turned) == ''
    assert f'{abs(angle):.0f} deg away' in fault_of([STEP] * 45, turned)


def test_pose_that_turns_against_odometry_is_a_fault():
    assert 'turns against odometry' in fault_of(curve(200), lambda step: step * MIRROR)


@pytest.mark.parametrize(
    'seen',
    [
        lambda step: step,
        lambda step: step * [1.3, 1.0, 0.6],  # wheels of another size
        lambda step: step * [0.1, 1.0, 0.0],  # wheels that slip
        lambda step: np.array([0.0, 0.2 * step[0], 0.0]),  # and the floor tilts
        lambda step: step * [1.0, 1.0, -0.4],  # turns on ice
        lambda step: step + np.array([0.0, 0.04, 0.01]),  # sideways
    ],
)
def test_poor_odometry_is_no_such_fault(seen):
    assert fault_of(curve(300), seen) == ''


def test_odometry_that_stands_still_is_a_fault():
    moves = fault_of([np.zeros(3)] * 25, lambda step: STEP)
    assert moves == ''
    assert 'stands still' in fault_of([np.zeros(3)] * 45, lambda step: STEP)


def drive(check, pose, steps):
    """Poses that move by the second of each pair, where odometry measures the first; the fault."""
    for step, moved, known in steps:
        drive.stamp += FRAME
        check.add_motion(drive.stamp, Motion(np.array(step), 1e-4 * np.eye(3), known))
        pose = se2.compose(pose, np.array(moved))
        found = check.fault(pose)
    return pose, found


drive.stamp = 0


def test_window_ends_where_odometry_has_a_gap():
    """Which the robot was carried through, backwards."""
    steps = [(STEP, STEP, True)] * 6 + [(STEP, -20.0 * STEP, False)] + [(STEP, STEP, True)] * 2
    assert drive(LaserCheck(), np.zeros(3), steps * 8)[1] == ''


def test_two_bad_windows_of_five_are_no_fault():
    good, bad = [(STEP, STEP, True)] * 10, [(STEP, -STEP, True)] * 10
    assert drive(LaserCheck(), np.zeros(3), (good + bad + good + bad + good) * 3)[1] == ''


def test_fault_of_the_mounting_stays_until_ten_windows_show_none():
    """A pose that follows mirrored odometry for a while agrees with it."""
    good, bad = [(STEP, STEP, True)] * 10, [(STEP, -STEP, True)] * 10
    check, pose = LaserCheck(), np.zeros(3)
    pose, found = drive(check, pose, bad * 5)
    assert '180 deg away' in found
    pose, found = drive(check, pose, good * 8)
    assert '180 deg away' in found
    pose, found = drive(check, pose, bad * 3 + good * 8)
    assert '180 deg away' in found
    assert drive(check, pose, good * 5)[1] == ''


def test_odometry_that_moves_again_is_no_fault():
    still, moves = [(np.zeros(3), STEP, True)] * 10, [(STEP, STEP, True)] * 10
    check = LaserCheck()
    pose, found = drive(check, np.zeros(3), still * 5)
    assert 'stands still' in found
    assert drive(check, pose, moves * 2)[1] == ''


def test_robot_that_only_turns_is_compared():
    step = np.array([0.0, 0.0, 0.1])
    assert 'turns against' in drive(LaserCheck(), np.zeros(3), [(step, -step, True)] * 25)[1]
    assert drive(LaserCheck(), np.zeros(3), [(step, step, True)] * 60)[1] == ''


def test_half_a_turn_in_one_step_is_not_compared():
    steps = [((0.0, 0.0, 3.1), (0.0, 0.0, 3.2), True)] * 12
    assert drive(LaserCheck(), np.zeros(3), steps)[1] == ''


def test_bias_of_a_gyro_while_the_robot_stands_is_no_turn():
    stands, turns = ((0.0, 0.0, -0.002), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.04), (0.0, 0.0, 0.042))
    steps = ([(*stands, True)] * 400 + [(*turns, True)] * 10) * 6  # 40 s, and 0.4 rad
    assert drive(LaserCheck(), np.zeros(3), steps)[1] == ''


def test_what_odometry_did_not_measure_is_not_compared():
    assert fault_of([STEP] * 60, lambda step: -step, known=False) == ''


def test_fault_is_forgotten_when_it_is_over():
    check, pose = LaserCheck(), np.zeros(3)
    for k in range(200):
        check.add_motion((k + 1) * FRAME, Motion(STEP, 1e-4 * np.eye(3)))
        pose = se2.compose(pose, -STEP if k < 60 else STEP)
        found = check.fault(pose)
        if k == 59:
            assert found
    assert found == ''
