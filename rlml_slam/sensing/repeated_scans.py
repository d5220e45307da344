# SPDX-License-Identifier: Apache-2.0
"""Tells a scan that a driver sends again under a new stamp: it hangs, or its laser does.

Noise lets no two scans be the same to the last bit, but in a simulation without any, where the
robot stands. One that is the same although odometry has moved on was not measured where its stamp
says: it would hold the robot where it was, until it seems to have been carried away.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

MOVED = 0.05  # [m, rad] by odometry: far beyond the noise of a range, and of a robot that stands
FEWEST = 30  # ranges: fewer, in whole centimetres, may come again by chance


class RepeatedScans:
    """The last new scan of each lidar, by its frame, and the odometry (3,) that it came with."""

    def __init__(self) -> None:
        self._new: dict[str, tuple[bytes, Array | None]] = {}

    def is_stale(self, scan: Scan, odometry: Array | None) -> bool:
        """Whether a scan is the one before once more, from a robot that has moved since.

        ``odometry`` (3,) is its pose at the scan's stamp, None where it has none; then none is.
        """
        ranges = scan.ranges.tobytes()
        before, there = self._new.get(scan.frame_id, (b'', None))
        few = np.count_nonzero(np.isfinite(scan.ranges)) < FEWEST
        if ranges != before or there is None or few:
            self._new[scan.frame_id] = (ranges, odometry)
            return False
        if odometry is None:
            return False
        x, y, turn = se2.between(there, odometry)
        return math.hypot(x, y) > MOVED or abs(turn) > MOVED
