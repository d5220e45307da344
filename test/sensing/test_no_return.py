# SPDX-License-Identifier: Apache-2.0
"""What stands for "no return" is left out, and no wall is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rlml_slam.sensing.no_return import NoReturnRanges
from rlml_slam.types import Scan

STEP = math.radians(1.0)


def scan_of(ranges, frame='laser', longest=80.0):
    r = np.array(ranges, dtype=np.float32)
    return Scan(1, frame, -math.pi / 2, STEP, 0.0, 0.0, longest, r, np.zeros(0, np.float32))


def corridor(code, distance=8.0):
    """A corridor 2 m wide; what is farther away than ``distance`` is ``code``."""
    angles = -math.pi / 2 + STEP * np.arange(181)
    r = 1.0 / np.maximum(np.abs(np.sin(angles)), 1e-9)
    return np.where(r < distance, np.round(r, 2), code)


@pytest.mark.parametrize(
    ('code', 'longest'), [(8.0, 8.0), (8.183, 80.0)], ids=['range_max', 'a code below range_max']
)
def test_arc_of_the_longest_range_is_no_return(code, longest):
    ranges = corridor(code, 5.0)
    left = NoReturnRanges().left_out(scan_of(ranges, longest=longest)).ranges
    assert_array_equal(np.isnan(left), ranges == code)
    assert_array_equal(left[ranges != code], ranges[ranges != code].astype(np.float32))


def test_two_codes_in_one_scan_are_both_left_out():
    ranges = np.r_[np.full(20, 8.19), np.full(20, 8.18), np.linspace(2.0, 3.0, 50)]
    assert_array_equal(np.isnan(NoReturnRanges().left_out(scan_of(ranges)).ranges), ranges > 8.0)


def test_single_beams_of_a_known_code_are_left_out_for_that_lidar_alone():
    none = NoReturnRanges()
    none.left_out(scan_of(corridor(8.0, 5.0)))
    ranges = np.array([1.0, 8.0, 1.5, 8.0])
    assert_array_equal(np.isnan(none.left_out(scan_of(ranges)).ranges), ranges == 8.0)
    other = scan_of(ranges, 'other')
    assert none.left_out(other) is other


def test_a_range_that_is_not_the_longest_is_no_code_any_more():
    none = NoReturnRanges()
    none.left_out(scan_of(corridor(8.0, 5.0)))
    farther = scan_of([1.0, 8.0, *np.linspace(8.5, 9.5, 12), 2.0])
    assert_array_equal(none.left_out(farther).ranges, farther.ranges)
    assert none.left_out(farther) is farther


@pytest.mark.parametrize('known', [False, True])
def test_stray_beam_beyond_a_code_does_not_make_a_wall_of_it(known):
    ranges = corridor(8.183, 5.0)
    none = NoReturnRanges()
    if known:
        none.left_out(scan_of(ranges))
    stray = ranges.copy()
    stray[[3, 90] if known else [3, 170]] = 12.0
    for _ in range(3):
        left = none.left_out(scan_of(stray)).ranges
        assert_array_equal(np.isnan(left), stray == 8.183)
        assert left[3] == 12.0


@pytest.mark.parametrize('distance', [1.0, 2.5, 5.0, 12.0])
def test_flat_wall_right_ahead_is_kept(distance):
    angles = STEP * np.arange(-12, 13)
    ranges = np.concatenate([np.full(40, 0.8), np.round(distance / np.cos(angles), 2)])
    scan = scan_of(ranges)
    assert NoReturnRanges().left_out(scan) is scan


def test_zero_is_no_return_even_if_it_is_not_less_than_the_least_range():
    left = NoReturnRanges().left_out(scan_of([0.0, 1.0, np.nan, np.inf])).ranges
    assert_array_equal(left, np.array([np.nan, 1.0, np.nan, np.inf], np.float32))


def test_equal_ranges_that_are_no_neighbours_are_kept():
    ranges = np.tile(np.r_[np.full(7, 8.0), 7.9, np.full(7, 8.0), np.nan], 20)
    scan = scan_of(ranges)
    assert NoReturnRanges().left_out(scan) is scan
