# SPDX-License-Identifier: Apache-2.0
"""The covariance of range and bearing, in the axes of the sensor."""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.sensing.polar import polar_covariance


def test_it_is_long_across_where_bearing_noise_rules():
    cov = polar_covariance(np.array([[0.0, 1.0]]), 0.02**2, np.array([(10.0 * 0.01) ** 2]))[0]
    np.testing.assert_allclose(cov, np.diag([0.1**2, 0.02**2]), atol=1e-12)


def test_it_is_the_diagonal_one_turned_by_the_bearing():
    bearing = np.linspace(-np.pi, np.pi, 7)
    R = se2.rotation(bearing)
    cov = polar_covariance(R[:, :, 0], np.full(7, 0.01), np.full(7, 0.0064))
    np.testing.assert_allclose(cov, R @ np.diag([0.01, 0.0064]) @ R.swapaxes(1, 2), atol=1e-15)
