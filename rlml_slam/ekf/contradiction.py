# SPDX-License-Identifier: Apache-2.0
"""Reflectors that contradict the map of the EKF: those that should be in view are replaced.

The robot was moved, or its pose is wrong; or it drove through a door. While it lasts, nothing is
mapped, which would agree with itself. In a map in the making, mapping goes on after a while: the
map may then be in two parts, until landmarks of the first one are seen again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.estimation.kidnapping_detection import FEW, LAPSE, agree_with_map
from rlml_slam.params import HealthLimits
from rlml_slam.se2 import Array

WITHIN = 0.9  # share of the largest range, and bearing, at which anything was detected
REPLACED = 'reflectors that should be in view are missing, and others are seen'
MOVED = f'{REPLACED}: the robot may have been moved; the EKF does not search it: set its pose'
TWO_PARTS = 'no reflector that was mapped before is seen: the map may be in two parts'


class Contradiction:
    """``holds`` while nothing is to be mapped, ``reason`` and ``is_lost`` for the health."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._view = np.zeros(2)  # [m], [rad] largest range and bearing so far
        self._since: int | None = None  # stamp of the first frame that contradicts
        self._newest = 0  # and of the newest
        self._second_part: int | None = None  # first key of the landmarks that it has
        self.holds = self.is_lost = False
        self.reason = ''

    def check(
        self, stamp: int, z: Array, used: NDArray[np.int64], landmarks: Array, next_key: int,
        mapping: bool,
    ) -> None:  # fmt: skip
        """Take a frame: range and bearing ``z`` (n, 2) of its detections, and what they match.

        ``used`` are the keys of the landmarks that match, ``landmarks`` (m, 2) all that are near,
        from the robot, and ``next_key`` is that of the next one that is mapped.
        """
        n, num, limits = len(z), len(used), self._limits
        agree = num > 1 or agree_with_map(n, num)
        self._view = np.maximum(self._view, np.abs(z).max(axis=0, initial=0.0))
        if agree:
            self._since = None
        elif n > FEW and self._in_view(landmarks) > FEW:
            self._since, self._newest = self._since or stamp, stamp
        elif stamp - self._newest > LAPSE * 1e9:  # nothing is said any more
            self._since = None
        lasts = 0.0 if self._since is None else (self._newest - self._since) * 1e-9
        self.holds = self._since is not None
        if mapping and lasts >= limits.new_session_time:
            self.holds = False
            if self._second_part is None:
                self._second_part = next_key
        part = self._second_part
        if part is not None and (used < part).sum() > 1:
            self._second_part = part = None
        self.is_lost = not mapping and lasts >= limits.confirmation_time
        self.reason = '' if part is None else TWO_PARTS
        if self.holds and lasts >= limits.lost_time:
            self.reason = REPLACED if mapping else MOVED

    def _in_view(self, landmarks: Array) -> int:
        """How many landmarks (m, 2) are where others were detected before."""
        ranges = np.hypot(landmarks[:, 0], landmarks[:, 1])
        bearings = np.abs(np.arctan2(landmarks[:, 1], landmarks[:, 0]))
        return int(((ranges < WITHIN * self._view[0]) & (bearings < WITHIN * self._view[1])).sum())
