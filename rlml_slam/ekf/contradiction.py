# SPDX-License-Identifier: Apache-2.0
"""Reflectors that contradict the map of the EKF: all that were in view are replaced by others.

The robot was moved, or it is lost; or it drove through a door. While it lasts, nothing is mapped,
which would agree with itself. In a map in the making, mapping goes on after a while: the map may
then be in two parts, until a landmark of the first one is seen again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.estimation.kidnapping_detection import FEW, KidnappingDetection, agree_with_map
from rlml_slam.params import HealthLimits

MOVED = (
    'reflectors contradict the map: the robot may have been moved, or may be lost; '
    'the EKF does not search it: set its pose'
)
TWO_PARTS = 'no reflector that was mapped before is seen: the map may be in two parts'


class Contradiction:
    """``holds`` while it lasts, ``is_lost`` where it lasts too long; ``reason`` for the health."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._detection = KidnappingDetection(limits)
        self._second_part: int | None = None  # first key of the landmarks that it has
        self.holds = self.is_lost = False
        self.reason = ''

    def check(
        self, stamp: int, n: int, used: NDArray[np.int64], next_key: int, mapping: bool
    ) -> None:
        """Take a frame with ``n`` detections, of which landmarks with the keys ``used`` match.

        ``next_key`` is that of the next landmark that is mapped.
        """
        limits, moved = self._limits, self._detection
        agree = agree_with_map(n, len(used))
        if n > FEW or agree:  # few that are not known may be ghosts
            moved.check(stamp, False, False, n, len(used), surveyed=not mapping)
        self.is_lost = moved.has_lasted(stamp, limits.lost_time)
        self.holds = moved.since is not None
        if mapping and moved.has_lasted(stamp, limits.new_session_time):
            self.holds = False
            if self._second_part is None:
                self._second_part = next_key
        part = self._second_part
        if part is not None and agree_with_map(n, int((used < part).sum())):
            self._second_part = part = None
        self.reason = MOVED if self.is_lost else '' if part is None else TWO_PARTS
