# SPDX-License-Identifier: Apache-2.0
"""A laser that is mounted otherwise than its transform says, seen by the whole system."""

import dataclasses

import numpy as np
import pytest
from made_worlds import ROOM, drive, messages

from rlml_slam.params import Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Health, Level, Odometry, Scan

DRIVE = drive(
    (0.5, 0.0, 5.0), (0.4, 0.6, 5.0), (0.4, -0.5, 6.0), (0.4, 0.5, 7.0), start=(-1.5, -1.9, 0.0)
)


def upside_down(scan):
    return dataclasses.replace(
        scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment
    )


@pytest.fixture
def healths():
    def of(given, mounted=lambda scan: scan):
        slam, out = Slam(Parameters()), []
        slam.set_sensor_pose('laser', np.array(given))
        for m in messages(ROOM, DRIVE, reflectors=False, rng=np.random.default_rng(0)):
            add = slam.add_odometry if isinstance(m, Odometry) else slam.add_scan
            out += add(mounted(m) if isinstance(m, Scan) else m)
        return [frame.health for frame in out]

    return of


@pytest.mark.parametrize(
    ('given', 'mounted', 'why'),
    [
        ([0.0, 0.0, np.pi], lambda scan: scan, '180 deg away from where odometry goes'),
        ([0.0, 0.0, -np.pi / 2], lambda scan: scan, '90 deg away from where odometry goes'),
        ([0.0, 0.0, 0.0], upside_down, 'the pose turns against odometry'),
    ],
)
def test_health_is_degraded_and_says_why(healths, given, mounted, why):
    found = healths(given, mounted)
    assert found[-1].level != Level.OK
    assert any(why in reason for reason in found[-1].reasons), found[-1]


def test_nothing_is_said_of_a_laser_that_is_where_its_transform_says(healths):
    found = healths([0.0, 0.0, 0.0])
    assert found[-1] == Health(Level.OK)
    reasons = [reason for health in found for reason in health.reasons]
    assert not any('where odometry goes' in r or 'against odometry' in r for r in reasons), reasons


def test_transform_that_comes_late_ends_the_fault_of_the_assumed_place():
    slam, healths, late = Slam(Parameters()), [], False
    slam.set_sensor_pose('laser', np.array([0.0, 0.0, np.pi]))
    for m in messages(ROOM, DRIVE, reflectors=False, rng=np.random.default_rng(0)):
        if not late and healths and 'away from where odometry' in ' '.join(healths[-1].reasons):
            slam.set_sensor_pose('laser', np.zeros(3))
            slam.session.restart(misplaced=True)
            healths.clear()
            late = True
        add = slam.add_odometry if isinstance(m, Odometry) else slam.add_scan
        healths += [frame.health for frame in add(m)]
    assert late
    assert len(healths) > 20
    assert not any('away from' in reason for health in healths for reason in health.reasons)
