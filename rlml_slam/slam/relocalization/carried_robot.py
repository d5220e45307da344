# SPDX-License-Identifier: Apache-2.0
"""Whether a robot that contradicts the map in the making was carried to another place.

It was, where one scan shows another place than the one just before, and not where it drove there.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from rlml_slam import params, se2
from rlml_slam.estimation.health import ScanEvidence
from rlml_slam.se2 import Array
from rlml_slam.types import Observation

SOON = 250_000_000  # [ns] between two scans, in which a robot drives nowhere else
BY_CHANCE = 1_000_000_000  # [ns] in which scans of another place may fit
SAME, SAME_SHARE = 0.1, 0.02  # [m], and share of the range, by which the same walls may be apart


class CarriedRobot:
    """Follows all scans of a robot; ``leapt`` where the newest contradiction of the map began."""

    def __init__(self) -> None:
        self._way = np.zeros(3)
        # by laser, its last scan, if it is not older than SOON, and the way until it
        self._before: dict[str, tuple[Observation, Array]] = {}
        self._fits = 0  # stamp of the first scan that fits again
        self.leapt = False

    def follow(self, observation: Observation, scan: ScanEvidence, since: int | None) -> None:
        """Take the next frame, and the stamp of the first contradiction, None without one."""
        self._way = se2.compose(self._way, observation.motion.delta)
        soon = observation.stamp - SOON
        self._before = {k: seen for k, seen in self._before.items() if seen[0].stamp >= soon}
        if since == observation.stamp:
            fits_anywhere = scan.used and scan.open_direction is not None
            self.leapt |= fits_anywhere or (scan.misfit and self._leaps(observation))
        elif since is None and scan.used:
            self._fits = self._fits or observation.stamp
            self.leapt &= observation.stamp - self._fits < BY_CHANCE
        if since is not None or (scan.has_scan and not scan.used):
            self._fits = 0
        if observation.points is not None:
            self._before[_laser(observation)] = observation, self._way

    def _leaps(self, observation: Observation) -> bool:
        """Of slow lasers it cannot be said: between two scans a robot goes through a door."""
        before, way = self._before.get(_laser(observation), (observation, self._way))
        if before.points is None or not len(before.points) or observation.points is None:
            return False
        points = se2.transform(se2.between(way, self._way), observation.points)
        gap, _ = cKDTree(before.points).query(points)
        near = SAME + SAME_SHARE * np.hypot(*observation.points.T)
        return bool(np.mean(gap < near) < 0.5)


def _laser(observation: Observation) -> str:
    return '' if observation.scan is None else observation.scan.frame_id


def unknown_way(p: params.Parameters) -> Array:
    """Covariance (3, 3) of a motion that nobody knows: 1 sigma is as far as the laser is used.

    It is lost there, whatever range the parameters say.
    """
    far = max(p.submap.max_laser_range, 2.0 * p.health.sigma_lost)
    return np.diag([far, far, math.pi / math.sqrt(3.0)]) ** 2
