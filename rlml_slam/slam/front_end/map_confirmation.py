# SPDX-License-Identifier: Apache-2.0
"""Whether the map that a robot localizes in agrees with its pose: at the start, and ever after.

Between two confirmations, odometry and the front end's own submaps hold the pose, and they do so
well for a while: what matters is how far the robot has gone on them alone.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.params import Parameters
from rlml_slam.slam.front_end.grid_localization import Fix

# [m, m, rad] what RViz says of a pose set by hand: a start that is only assumed is no better
START_SIGMA = np.array([0.5, 0.5, 0.26])


class MapConfirmation:
    """Judges frame by frame; ``reason`` says what is missing, empty where nothing is.

    ``is_pending``: the pose is still the one that was told or assumed. ``is_lost``: it is for too
    long, or what is seen has contradicted the map for as long.
    """

    def __init__(self, params: Parameters) -> None:
        self._limits = params.health
        self._least = params.loop_closure.min_score
        self._needed = self.is_pending = params.node.mode == 'localization'
        self.reason = 'no map to localize in has come' if self._needed else ''
        self.is_lost = False
        self._gone = 0.0
        self._since: int | None = None  # stamp of the newest frame with nothing against the pose

    def begin(self) -> None:
        """There is a map from now on."""
        self._needed = self.is_pending = True
        self.reason = 'nothing has matched the saved map yet'

    def judge(
        self, stamp: int, distance: float, detections: int, used: int, agrees: bool, fix: Fix
    ) -> None:
        """One frame, ``distance`` [m] after the one before.

        Of its ``detections``, so many are ``used``, and all in all they may agree with the map;
        ``fix`` is the newest one in its grid, without a score where there is none.
        """
        if not self._needed:
            return
        if self._starts(detections, used, fix) if self.is_pending else agrees or fix.used:
            self.reason, self.is_pending, self.is_lost = '', False, False
            self._gone, self._since = 0.0, None
            return
        if self._since is None or not (self.is_pending or fix.contradicts):
            self._since = stamp
        self._gone += distance
        if not self.is_pending and self._gone > self._limits.confirmation_distance:
            self.reason = f'the saved map has not confirmed the pose for {self._gone:.0f} m'
            if fix.contradicts:
                self.reason += ', and the scan contradicts it'
        lasts = stamp - self._since > self._limits.confirmation_time * 1e9
        self.is_lost = bool(self.reason) and lasts

    def _starts(self, detections: int, used: int, fix: Fix) -> bool:
        """Whether a pose that was told or assumed is the robot's.

        Two reflectors that are most of what is seen confirm it, where the scan does not say
        otherwise; so does a scan that fits the grid and holds every direction.
        """
        seen = used >= 2 and 2 * used >= detections
        fits = fix.score >= self._least
        return (seen and not fix.score < self._least) or (fits and fix.held)
