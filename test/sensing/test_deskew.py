# SPDX-License-Identifier: Apache-2.0
"""A sweep of a robot that begins to turn within it: its end points are where the walls are."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.sensing.deskew import ARC, MOST_ARCS, base_at, num_arcs, project
from rlml_slam.types import Scan

N, LASTS, RADIUS = 720, 0.2, 4.0
T_BASE_LASER = np.array([0.2, -0.1, 0.4])
BEGINS = 0.08  # [s] into the sweep, when the robot begins to turn
TWIST, TURN = np.array([0.8, 0.0, 0.0]), np.array([0.0, 0.0, 1.5])


def base(t, begins=BEGINS):
    """Poses (n, 3) of base at times (n,) of the sweep."""
    before, after = np.minimum(t, begins), np.maximum(t - begins, 0.0)
    return se2.compose(se2.exp(before[:, None] * TWIST), se2.exp(after[:, None] * (TWIST + TURN)))


def sweep(arcs, begins=BEGINS):
    return base(np.arange(1, arcs + 1) / arcs * LASTS, begins)


def scan_of_circle(begins=BEGINS):
    """Ranges to a circle around where base is at the first ray."""
    increment = 2.0 * np.pi / N
    T = se2.compose(base(np.arange(N) / N * LASTS, begins), T_BASE_LASER)
    beam = T[:, 2] - np.pi + increment * np.arange(N)
    d = np.stack([np.cos(beam), np.sin(beam)], -1)
    along = (T[:, :2] * d).sum(1)
    ranges = -along + np.sqrt(along**2 - (T[:, :2] ** 2).sum(1) + RADIUS**2)
    return Scan(
        0, 'laser', -np.pi, increment, LASTS / N, 0.1, 30.0, ranges.astype(np.float32),
        np.zeros(0, np.float32),
    )  # fmt: skip


def bearing_errors(points, begins):
    """How far each end point is from where its beam met the circle, as an angle [rad]."""
    T = se2.compose(base(np.arange(N) / N * LASTS, begins), T_BASE_LASER)
    scan = scan_of_circle(begins)
    beam = -np.pi + scan.angle_increment * np.arange(N)
    local = scan.ranges[:, None] * np.stack([np.cos(beam), np.sin(beam)], -1)
    true = se2.transform(T, local[:, None])[:, 0]
    angle = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    return se2.wrap(angle)


@pytest.mark.parametrize(
    ('begins', 'most'), [(BEGINS, 1e-3), (BEGINS + 0.5 * ARC, 1.1 * TURN[2] * ARC / 4.0)]
)
def test_end_points_are_where_they_were_seen_though_the_robot_begins_to_turn(begins, most):
    """At most what the turn within one arc leaves, where it begins in the middle of it."""
    scan = scan_of_circle(begins)
    arcs, one = (project(scan, T_BASE_LASER, sweep(n, begins), 30.0) for n in (10, 1))
    assert num_arcs(LASTS) == 10
    by_arcs, as_one = bearing_errors(arcs, begins), bearing_errors(one, begins)
    assert np.abs(by_arcs).max() < most
    assert abs(as_one.mean()) > 0.02  # which a match of the scan takes for a turn of the robot


def test_motion_of_constant_twist_is_the_same_in_any_number_of_arcs():
    scan = scan_of_circle()
    whole = np.array([[0.15, 0.01, 0.3]])
    parts = se2.exp(np.arange(1, 8)[:, None] / 7.0 * se2.log(whole))
    one, more = (project(scan, T_BASE_LASER, s, 30.0) for s in (whole, parts))
    # chords of the one arc: w^2 / 24 of the way
    assert_allclose(one, more, atol=0.15 * 0.3**2 / 24.0 * 1.5)


def test_pose_within_a_sweep_is_that_of_its_arc():
    share = np.array([0.0, 0.1, 0.35, 0.4, 0.7, 1.0])
    arcs = num_arcs(LASTS)
    assert_allclose(base_at(sweep(arcs), share), base(share * LASTS), atol=1e-12)
    one = np.array([[0.1, 0.02, 0.3]])
    assert_allclose(base_at(one, share), se2.exp(share[:, None] * se2.log(one)), atol=1e-12)


@pytest.mark.parametrize(
    ('lasts', 'arcs'), [(0.0, 1), (0.5 * ARC, 1), (1.5 * ARC, 2), (0.1, 5), (1e6, MOST_ARCS)]
)
def test_number_of_arcs_is_bounded(lasts, arcs):
    assert num_arcs(lasts) == arcs
