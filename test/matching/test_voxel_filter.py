# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.matching.scans.voxel_filter import thin

POINTS = np.random.default_rng(1).uniform(-4.0, 4.0, size=(3000, 2))


def test_keeps_the_middle_point_of_every_voxel_in_order():
    kept = thin(POINTS, 0.5, 10000)
    middle = []
    for cell in np.unique(np.floor(POINTS / 0.5), axis=0):
        (there,) = np.nonzero((np.floor(POINTS / 0.5) == cell).all(axis=1))
        both = there[(len(there) - 1) // 2], there[len(there) // 2]
        middle.append(min(both, key=lambda k: np.abs(POINTS[k]) @ (1.0, np.sqrt(2.0))))
    assert len(middle) < len(POINTS)
    np.testing.assert_array_equal(kept, POINTS[np.sort(middle)])


@pytest.mark.parametrize(('voxel', 'most'), [(0.5, 10000), (0.1, 10000), (0.1, 76), (0.0, 250)])
def test_the_order_of_the_beams_does_not_matter(voxel, most):
    kept = thin(POINTS, voxel, most)
    np.testing.assert_array_equal(thin(POINTS[::-1], voxel, most), kept[::-1])


@pytest.mark.parametrize('digits', [2, 3, 9])
def test_a_mirrored_scan_is_thinned_alike(digits):
    """Ranges are often rounded, so that neighbours have the same."""
    beams = np.radians(np.arange(-134.9, 135.0, 0.25))
    ranges = np.round(3.0 + np.sin(3.0 * beams + 0.5), digits)
    points = ranges[:, None] * np.column_stack([np.cos(beams), np.sin(beams)])
    flip, kept = np.array([1.0, -1.0]), thin(points, 0.1, 100000)
    assert len(kept) < 0.5 * len(points)
    np.testing.assert_array_equal(thin(points[::-1], 0.1, 100000), kept[::-1])
    np.testing.assert_array_equal(thin((points * flip)[::-1], 0.1, 100000), (kept * flip)[::-1])


def test_thinning_again_changes_nothing():
    kept = thin(POINTS, 0.5, 120)
    assert len(kept) == 120
    np.testing.assert_array_equal(thin(kept, 0.5, 120), kept)


def test_at_most_max_points_evenly_chosen():
    kept = thin(POINTS, 0.0, 300)
    near = np.arange(150) * 10 + 5
    np.testing.assert_array_equal(kept, POINTS[[*near, *(2999 - near[::-1])]])


def test_points_that_are_not_finite_are_dropped():
    bad = np.array([[0.0, np.nan], [1.0, 1.0], [np.inf, 0.0], [2.0, 2.0]])
    np.testing.assert_array_equal(thin(bad, 0.1, 10), bad[[1, 3]])
    assert thin(np.zeros((0, 2)), 0.1, 10).shape == (0, 2)
