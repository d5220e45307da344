# SPDX-License-Identifier: Apache-2.0
"""A laser that is mounted otherwise than its transform says is found by odometry."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.estimation.laser_check import LaserCheck
from rlml_slam.types import Motion

STEP = np.array([0.1, 0.0, 0.0])
MIRROR = np.array([1.0, -1.0, -1.0])


def fault_of(steps, seen, known=True):
    """The fault after poses that move by ``seen(step)`` where odometry measures ``step``."""
    check, pose = LaserCheck(), np.zeros(3)
    check.fault(pose)
    for step in steps:
        check.add_motion(Motion(np.array(step), 1e-4 * np.eye(3), known))
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
    assert 'turn against odometry' in fault_of(curve(200), lambda step: step * MIRROR)


@pytest.mark.parametrize(
    'seen',
    [
        lambda step: step,
        lambda step: step * [1.3, 1.0, 0.6],  # wheels of another size
        lambda step: step * [0.1, 1.0, 0.0],  # wheels that slip
        lambda step: step + np.array([0.0, 0.04, 0.01]),  # sideways
    ],
)
def test_poor_odometry_is_no_such_fault(seen):
    assert fault_of(curve(300), seen) == ''


def test_what_odometry_did_not_measure_is_not_compared():
    assert fault_of([STEP] * 60, lambda step: -step, known=False) == ''


def test_fault_is_forgotten_when_it_is_over():
    check, pose = LaserCheck(), np.zeros(3)
    for k in range(200):
        check.add_motion(Motion(STEP, 1e-4 * np.eye(3)))
        pose = se2.compose(pose, -STEP if k < 60 else STEP)
        found = check.fault(pose)
        if k == 59:
            assert found
    assert found == ''
