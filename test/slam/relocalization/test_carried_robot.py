# SPDX-License-Identifier: Apache-2.0
"""A robot that was carried is distinguished from one that drove there itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.estimation.health import ScanEvidence
from rlml_slam.params import Parameters, Submap
from rlml_slam.slam.relocalization.carried_robot import CarriedRobot, unknown_way
from rlml_slam.types import Motion, Observation, Scan

SECOND = 1_000_000_000
ANGLES = np.linspace(-1.5, 1.5, 180)
STEP = np.array([0.1, 0.0, 0.15])


def room(side, pose):
    """End points (n, 2), seen from a pose, of the walls of a square room."""
    beams = np.stack([np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])], axis=1)
    walls = np.where(beams > 0.0, side, -side)
    ends = pose[:2] + beams * ((walls - pose[:2]) / beams).min(axis=1, keepdims=True)
    return se2.transform(se2.inverse(pose), ends)


GOOD = ScanEvidence(has_scan=True, used=True)
MISFIT = ScanEvidence(has_scan=True, misfit=True)
ALONG = ScanEvidence(has_scan=True, used=True, open_direction=0.0)


def leapt(second, period, scan=MISFIT, between=(), after=()):
    """Whether a contradiction begins with a leap, at the second of two scans."""
    carried = CarriedRobot()
    first = room(4.0, np.array([1.0, -0.5, 0.3]))
    carried.follow(Observation(SECOND, Motion(np.zeros(3), np.eye(3)), first), GOOD, None)
    stamp = SECOND + period
    for motion in between:  # detections alone
        carried.follow(Observation(SECOND + 1, Motion(motion, np.eye(3))), ScanEvidence(), None)
    now = Observation(stamp, Motion(STEP, 1e-4 * np.eye(3)), second)
    carried.follow(now, scan, stamp)
    for then, since in after:
        stamp += period
        still = Motion(np.zeros(3), np.eye(3))
        carried.follow(Observation(stamp, still, second), then, stamp if since else None)
    return carried.leapt


@pytest.mark.parametrize('period', [25_000_000, 200_000_000])
def test_another_room_is_a_leap_and_the_way_through_the_same_one_is_not(period):
    there = se2.compose(np.array([1.0, -0.5, 0.3]), STEP)
    assert not leapt(room(4.0, there), period)
    assert leapt(room(9.0, there), period)
    people = room(4.0, there)
    people[60:100] *= 0.2  # before the robot
    assert not leapt(people, period)


def test_detections_between_two_scans_change_nothing():
    back = se2.inverse(STEP)
    there = room(4.0, np.array([1.0, -0.5, 0.3]))
    assert not leapt(there, 25_000_000, between=(back,))
    assert leapt(room(9.0, STEP), 25_000_000, between=(back,))


def test_slow_laser_and_missing_scan_say_nothing():
    assert not leapt(room(9.0, STEP), 600_000_000)
    assert not leapt(None, 25_000_000, ScanEvidence())


def test_frame_without_a_scan_or_one_that_fits_by_chance_does_not_end_what_began_with_a_leap():
    there, slow = room(9.0, STEP), 200_000_000
    assert leapt(there, slow, after=[(ScanEvidence(), False), (MISFIT, True)])
    assert leapt(there, slow, after=[(GOOD, False), (MISFIT, True)])
    again = [*[(GOOD, False)] * 4, (MISFIT, True)] * 3  # never for a second
    assert leapt(there, slow, after=again)
    assert not leapt(there, slow, after=[*[(GOOD, False)] * 6, (MISFIT, True)])
    unused = (ScanEvidence(has_scan=True), False)  # it does not fit: the second begins again
    assert leapt(
        there, slow, after=[*[(GOOD, False)] * 4, unused, *[(GOOD, False)] * 4, (MISFIT, True)]
    )


def test_scan_that_fits_where_reflectors_do_not_is_no_way_that_was_seen():
    """In a bare corridor it fits anywhere."""
    assert leapt(room(4.0, STEP), 25_000_000, ALONG)


def test_scan_is_compared_with_the_one_before_of_the_same_laser():
    """The other laser looks back: what it sees was a leap, and the robot LOST until found."""
    carried, here = CarriedRobot(), np.array([1.0, -0.5, 0.3])
    back = se2.compose(here, np.array([0.0, 0.0, np.pi]))
    still = Motion(np.zeros(3), np.eye(3))
    for k in range(6):
        name, pose = (('front', here), ('back', back))[k % 2]
        scan = Scan(SECOND + k, name, -1.5, 1.0, 0.0, 0.1, 30.0, np.ones(1), np.ones(0))
        seen = Observation(SECOND + k, still, room(4.0, pose), scan=scan)
        carried.follow(seen, MISFIT, SECOND + k if k > 1 else None)
        assert not carried.leapt
    seen = Observation(SECOND + 6, still, room(9.0, here), scan=replace(scan, frame_id='front'))
    carried.follow(seen, MISFIT, SECOND + 6)
    assert carried.leapt


def test_scans_of_any_number_of_lasers_are_not_kept():
    """Where no transform is known, every name of a frame is one of a laser."""
    carried, still = CarriedRobot(), Motion(np.zeros(3), np.eye(3))
    for k in range(200):
        scan = Scan(SECOND, f'laser{k}', -1.5, 1.0, 0.0, 0.1, 30.0, np.ones(1), np.ones(0))
        seen = Observation(SECOND + k * 10_000_000, still, np.ones((3, 2)), scan=scan)
        carried.follow(seen, GOOD, None)
    assert len(carried._before) <= 26  # of a quarter of a second, at 100 Hz


def test_robot_that_may_be_anywhere_is_lost_whatever_the_range_of_its_laser():
    near = Parameters(submap=Submap(max_laser_range=1.5))
    assert unknown_way(near)[0, 0] > Parameters().health.sigma_lost ** 2
    assert unknown_way(Parameters())[0, 0] == Parameters().submap.max_laser_range ** 2
