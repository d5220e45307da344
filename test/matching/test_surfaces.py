# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.matching.scans.surfaces import MAX_GAP, constraints, fill


def line(angle: float, n: int = 9, spacing: float = 0.1) -> np.ndarray:
    direction = np.array([np.cos(angle), np.sin(angle)])
    return 3.0 * np.array([-direction[1], direction[0]]) + np.outer(
        np.arange(n) * spacing, direction
    )


@pytest.mark.parametrize('angle', [0.0, 0.4, 1.57, 2.5, -2.0])
def test_point_on_a_wall_is_held_across_it_only(angle):
    a, b, c = constraints(line(angle))[4]
    normal = np.array([-np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose([[a, b], [b, c]], np.outer(normal, normal), atol=1e-12)


def test_point_in_clutter_is_held_both_ways_and_a_lonely_one_not_at_all():
    clutter = np.random.default_rng(0).uniform(-0.3, 0.3, size=(9, 2))
    np.testing.assert_array_equal(constraints(clutter)[4], [1.0, 0.0, 1.0])
    lonely = np.array([[0.0, 0.0], [0.1, 0.0], [5.0, 0.0], [9.0, 0.0], [9.1, 0.0]])
    np.testing.assert_array_equal(constraints(lonely), np.zeros((5, 3)))


def test_gap_is_filled_at_the_spacing():
    wall = line(0.7, spacing=0.39)
    filled = fill(wall, 0.05)
    measured = (filled[:, None] == wall).all(axis=-1).any(axis=1)
    np.testing.assert_array_equal(filled[measured], wall)
    # between points 1 and n - 2 every gap has neighbours on both sides
    steps = np.hypot(*np.diff(filled, axis=0).T)
    assert len(filled) == len(wall) + 6 * 8
    assert np.sort(steps)[-3] <= 0.05 + 1e-9 < np.sort(steps)[-2]


@pytest.mark.parametrize(
    'points',
    [
        line(0.0, spacing=1.5 * MAX_GAP),  # as wide as a door
        np.array([[0.0, 0.0], [0.3, 0.3], [0.6, 0.0], [0.9, 0.3], [1.2, 0.0]]),  # not a line
        line(0.0, spacing=0.04),  # no gap
        line(0.0, n=2),
        np.zeros((0, 2)),
    ],
)
def test_what_is_no_gap_in_a_wall_is_not_filled(points):
    np.testing.assert_array_equal(fill(points, 0.05), points)


def test_noise_of_points_close_together_makes_no_clutter_of_a_wall():
    rng = np.random.default_rng(0)
    wall = np.stack([0.05 * np.arange(400), 1.2 + 0.01 * rng.standard_normal(400)], -1)
    held = constraints(wall)[10:-10]
    assert (held[:, 0] < 0.1).all()
    np.testing.assert_allclose(held[:, 0] + held[:, 2], 1.0, atol=1e-12)
