# SPDX-License-Identifier: Apache-2.0
"""A repeated scan is distinguished from a new scan of a robot at rest."""

import numpy as np
import pytest

from rlml_slam.sensing.repeated_scans import FEWEST, MOVED, RepeatedScans
from rlml_slam.types import Scan

RNG = np.random.default_rng(0)
HERE = np.array([3.0, -2.0, 0.5])


def scan(ranges, frame='laser'):
    r = np.array(ranges, dtype=np.float32)
    return Scan(1, frame, -1.0, 0.01, 0.0, 0.1, 20.0, r, np.zeros(0, dtype=np.float32))


WALL = RNG.uniform(1.0, 9.0, 2 * FEWEST)
WALL[3] = np.nan


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_the_same_scan_from_another_place_is_stale(axis):
    repeats, step = RepeatedScans(), np.zeros(3)
    step[axis] = 0.6 * MOVED
    assert not repeats.is_stale(scan(WALL), HERE)
    assert not repeats.is_stale(scan(WALL), HERE + step)
    # however slowly it got there: what counts is the way since it was new
    assert repeats.is_stale(scan(WALL), HERE + 2.0 * step)
    assert repeats.is_stale(scan(WALL), HERE + 3.0 * step)
    assert not repeats.is_stale(scan(WALL + 0.001), HERE + 3.0 * step)
    assert not repeats.is_stale(scan(WALL + 0.001), HERE + 3.0 * step)


def test_one_beam_that_differs_makes_a_scan_new():
    repeats, other = RepeatedScans(), WALL.copy()
    other[7] += 1e-3
    repeats.is_stale(scan(WALL), HERE)
    assert not repeats.is_stale(scan(other), HERE + 1.0)


def test_without_odometry_nothing_tells():
    repeats = RepeatedScans()
    repeats.is_stale(scan(WALL), None)
    assert not repeats.is_stale(scan(WALL), None)
    assert not repeats.is_stale(scan(WALL), HERE)
    # from there on it does
    assert repeats.is_stale(scan(WALL), HERE + 1.0)


def test_scans_that_see_next_to_nothing_may_be_alike():
    repeats, empty = RepeatedScans(), np.full(2 * FEWEST, np.inf)
    empty[: FEWEST - 1] = 4.0
    repeats.is_stale(scan(empty), HERE)
    assert not repeats.is_stale(scan(empty), HERE + 1.0)


def test_each_lidar_has_its_own():
    repeats = RepeatedScans()
    repeats.is_stale(scan(WALL, 'front'), HERE)
    assert not repeats.is_stale(scan(WALL, 'rear'), HERE + 1.0)
    assert repeats.is_stale(scan(WALL, 'front'), HERE + 1.0)
