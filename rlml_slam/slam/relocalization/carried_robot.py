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
SAME, SAME_SHARE = 0.1, 0.02  # [m], and share of the range, by which the same walls may be apart


class CarriedRobot:
    """Follows all scans of a robot; ``leapt`` where the newest contradiction of the map began."""

    def __init__(self) -> None:
        self._before: Observation | None = None
        self._moved = np.zeros(3)  # since then
        self.leapt = False

    def follow(self, observation: Observation, scan: ScanEvidence, since: int | None) -> None:
        """Take the next frame, and the stamp of the first contradiction, None without one."""
        self._moved = se2.compose(self._moved, observation.motion.delta)
        if since == observation.stamp:
            fits_anywhere = scan.used and scan.open_direction is not None
            self.leapt |= fits_anywhere or (scan.misfit and self._leaps(observation))
        elif since is None and scan.used:
            self.leapt = False
        if observation.points is not None:
            self._before, self._moved = observation, np.zeros(3)

    def _leaps(self, observation: Observation) -> bool:
        """Of slow lasers it cannot be said: between two scans a robot goes through a door."""
        before, points = self._before, observation.points
        if before is None or before.points is None or not len(before.points) or points is None:
            return False
        if observation.stamp - before.stamp > SOON:
            return False
        gap, _ = cKDTree(before.points).query(se2.transform(self._moved, points))
        near = SAME + SAME_SHARE * np.hypot(points[:, 0], points[:, 1])
        return bool(np.mean(gap < near) < 0.5)


def unknown_way(p: params.Submap) -> Array:
    """Covariance (3, 3) of a motion that nobody knows: 1 sigma is as far as the laser is used."""
    return np.diag([p.max_laser_range, p.max_laser_range, math.pi / math.sqrt(3.0)]) ** 2
