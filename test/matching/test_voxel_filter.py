# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from rlml_slam.matching.scans.voxel_filter import thin

POINTS = np.random.default_rng(1).uniform(-4.0, 4.0, size=(3000, 2))


def test_keeps_the_first_point_of_every_voxel_in_order():
    kept = thin(POINTS, 0.5, 10000)
    cells, first = np.unique(np.floor(POINTS / 0.5), axis=0, return_index=True)
    assert len(cells) < len(POINTS)
    np.testing.assert_array_equal(kept, POINTS[np.sort(first)])


def test_thinning_again_changes_nothing():
    kept = thin(POINTS, 0.5, 120)
    assert len(kept) == 120
    np.testing.assert_array_equal(thin(kept, 0.5, 120), kept)


def test_at_most_max_points_evenly_chosen():
    kept = thin(POINTS, 0.0, 300)
    np.testing.assert_array_equal(kept, POINTS[np.arange(300) * 10])


def test_points_that_are_not_finite_are_dropped():
    bad = np.array([[0.0, np.nan], [1.0, 1.0], [np.inf, 0.0], [2.0, 2.0]])
    np.testing.assert_array_equal(thin(bad, 0.1, 10), bad[[1, 3]])
    assert thin(np.zeros((0, 2)), 0.1, 10).shape == (0, 2)
