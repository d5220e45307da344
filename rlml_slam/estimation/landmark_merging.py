# SPDX-License-Identifier: Apache-2.0
"""Merging of landmarks: the test whether two landmarks of a map are one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam.se2 import Array

MERGE_DISTANCE = 1.5  # [m] pairs farther apart are not tested
VARIANCE_FLOOR = 1e-6  # [m²] added to the covariance of the difference


@dataclass(frozen=True)
class MergeTest:
    """Test of two landmarks that were never seen at one time and have no different ids.

    ``gate`` of the squared Mahalanobis distance; below ``min_separation`` [m] the detector does
    not separate two. ``unmapped_density`` [1/m²] of unmapped landmarks, and the least
    ``match_probability`` against another one there: with a large covariance two are left.
    """

    gate: float
    min_separation: float
    match_probability: float
    unmapped_density: float

    def is_same(self, difference: Array, distance: float, cov: Array) -> bool:
        """Whether two are one, from their ``difference`` (2,) and its covariance (2, 2)."""
        cov = cov + VARIANCE_FLOOR * np.eye(2)
        peak = 1.0 / (2.0 * math.pi * math.sqrt(np.linalg.det(cov)))
        if peak < self.match_probability * (peak + self.unmapped_density):
            return False
        distance2 = difference @ np.linalg.solve(cov, difference)
        return bool(distance < self.min_separation or distance2 < self.gate)
