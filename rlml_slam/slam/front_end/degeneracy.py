# SPDX-License-Identifier: Apache-2.0
"""The direction that scans leave open, remembered from one scan to the next.

Along bare walls a scan carries no information, but the noise of each scan rotates its walls a
little. Held a hair across the true direction by one scan and across another hair by the next,
the pose would seem held along it as well: an information of the square of that noise, times the
number of scans, that is not there. The walls are the same, so the direction is: its mean over
the scans takes the place of that of each.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.scan_update import MIN_INFORMATION

# [rad, rad/m] Farther apart they are of other walls. The normals of a scan err by about
# sigma_point over the reach of neighbours, 0.06, less by averaging over tens of beams.
SAME = 0.02


class Degeneracy:
    """The mean direction (3,) of the pose, in local axes, that the last scans left open."""

    def __init__(self) -> None:
        self._mean = np.zeros(3)
        self._num = 0

    def cleared(self, information: Array, heading: float) -> Array:
        """The information (3, 3) of a match with none in that direction.

        It is in axes turned by ``heading``, those of the submap, and is left as it is where it
        holds all directions, or more than one is open.
        """
        values, axes = np.linalg.eigh(information)
        if not values[0] <= MIN_INFORMATION < values[1]:
            self._num = 0
            return information
        R = np.eye(3)
        c, s = math.cos(heading), math.sin(heading)
        R[:2, :2] = (c, -s), (s, c)
        newest = R @ axes[:, 0]
        newest *= math.copysign(1.0, newest @ self._mean)
        if self._num == 0 or np.linalg.norm(newest - self._mean) > SAME:
            self._mean, self._num = newest, 0
        self._num += 1
        self._mean += (newest - self._mean) / self._num
        open_ = R.T @ self._mean
        across = np.eye(3) - np.outer(open_, open_) / (open_ @ open_)
        cleared: Array = across @ information @ across
        return cleared
