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
        middle.append(min(both, key=lambda k: np.hypot(*POINTS[k])))
    assert len(middle) < len(POINTS)
    np.testing.assert_array_equal(kept, POINTS[np.sort(middle)])


@pytest.mark.parametrize(('voxel', 'most'), [(0.5, 10000), (0.1, 10000), (0.1, 76), (0.0, 250)])
def test_the_order_of_the_beams_does_not_matter(voxel, most):
    kept = thin(POINTS, voxel, most)
    np.testing.assert_array_equal(thin(POINTS[::-1], voxel, most), kept[::-1])


def test_a_mirrored_scan_is_thinned_alike():
    flip = np.array([1.0, -1.0])
    np.testing.assert_array_equal(
        thin((POINTS * flip)[::-1], 0.1, 300), (thin(POINTS, 0.1, 300) * flip)[::-1]
    )


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
