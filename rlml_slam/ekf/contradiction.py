# SPDX-License-Identifier: Apache-2.0
"""Reflectors that contradict the map in which the EKF localizes: those in view are replaced.

The robot was moved, or its pose is wrong. In a map in the making it is not looked for: there, new
landmarks among old ones that are hidden or missed are usual.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.estimation.kidnapping_detection import FEW, LAPSE, agree_with_map
from rlml_slam.params import HealthLimits
from rlml_slam.se2 import Array

WITHIN = 0.9  # share of the largest range, and bearing, at which anything was detected
MOVED = (
    'reflectors that should be in view are missing, and others are seen: the robot may have been '
    'moved; the EKF does not search it: set its pose'
)


class Contradiction:
    """``reason`` for the health, empty without one; ``is_lost`` where it lasts too long."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._view = np.zeros(2)  # [m], [rad] largest range and bearing so far
        self._since: int | None = None  # stamp of the first frame that contradicts
        self._newest = 0  # and of the newest
        self.is_lost = False
        self.reason = ''

    def check(self, stamp: int, z: Array, used: int, landmarks: Array) -> None:
        """Take a frame: range and bearing ``z`` (n, 2) of its detections, ``used`` of which match.

        ``landmarks`` (m, 2) are all that are near, from the robot.
        """
        self._view = np.maximum(self._view, np.abs(z).max(axis=0, initial=0.0))
        if used > 1 or agree_with_map(len(z), used):
            self._since = None
        elif len(z) > FEW and self._in_view(landmarks) > FEW:
            self._since, self._newest = self._since or stamp, stamp
        elif stamp - self._newest > LAPSE * 1e9:  # nothing is said any more
            self._since = None
        lasts = -1.0 if self._since is None else (self._newest - self._since) * 1e-9
        self.reason = MOVED if lasts >= self._limits.lost_time else ''
        self.is_lost = lasts >= self._limits.confirmation_time

    def _in_view(self, landmarks: Array) -> int:
        """How many landmarks (m, 2) are where others were detected before."""
        ranges = np.hypot(landmarks[:, 0], landmarks[:, 1])
        bearings = np.abs(np.arctan2(landmarks[:, 1], landmarks[:, 0]))
        return int(((ranges < WITHIN * self._view[0]) & (bearings < WITHIN * self._view[1])).sum())
