# SPDX-License-Identifier: Apache-2.0
"""Map to odom with corrections reported as jumps and, where wanted, limited in rate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rlml_slam import se2
from rlml_slam.params import BackEnd
from rlml_slam.se2 import Array

# [m, rad] a robot that is farther away was carried there, or believed itself elsewhere: a slow
# way there would lead through places where it never is
SUDDEN = np.array([1.0, 0.5])
TURN = 0.02  # [rad] a correction that turns by more is reported as well


class SmoothedCorrection:
    """Follows map to odom, in steps that move the robot no faster than ``correction_speed``.

    ``report`` is called with the stamp [ns] of each jump and the robot's new pose (3,) seen from
    where it was believed.
    """

    def __init__(self, params: BackEnd, report: Callable[[int, Array], None]) -> None:
        self._p = params
        self._report = report
        self._raw: Array | None = None
        self._published = np.zeros(3)
        self._stamp = 0

    def follow(self, stamp: int, T_map_odom: Array, T_odom_base: Array) -> Array:
        """What is to be published (3,) where the estimate is T_map_odom (3,)."""
        target = se2.compose(T_map_odom, T_odom_base)
        if self._raw is None:
            self._raw = self._published = T_map_odom
        jump = se2.between(se2.compose(self._raw, T_odom_base), target)
        if np.hypot(*jump[:2]) > self._p.jump_distance or abs(jump[2]) > TURN:
            self._report(stamp, jump)
        self._raw = T_map_odom
        dt, self._stamp = (stamp - self._stamp) * 1e-9, stamp
        shown = se2.compose(self._published, T_odom_base)
        left = se2.between(shown, target)
        step = left * self._share(left, dt)
        self._published = se2.compose(se2.compose(shown, step), se2.inverse(T_odom_base))
        return self._published

    def _share(self, left: Array, dt: float) -> float:
        """The part of the remaining correction that may be applied in ``dt`` [s]."""
        speed, turn_rate = self._p.correction_speed, self._p.correction_turn_rate
        size = np.array([np.hypot(left[0], left[1]), abs(left[2])])
        if speed == 0.0 or dt < 0.0 or (size > SUDDEN).any():
            return 1.0
        most = np.array([speed, turn_rate]) * dt
        return float(np.min(np.minimum(most / np.maximum(size, 1e-12), 1.0)))
