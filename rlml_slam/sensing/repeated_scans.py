# SPDX-License-Identifier: Apache-2.0
"""Detection of an old scan that a driver sends again with a new stamp, because it hangs.

Two scans are bitwise equal only in a simulation without noise, at standstill. If an equal scan
comes although odometry has moved, it is not from the time of its stamp; it would hold the estimate
at the old pose until the robot seems kidnapped.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

MOVED = 0.05  # [m, rad] by odometry: far beyond the noise of a range, and of standstill
FEWEST = 30  # ranges: fewer, in whole centimetres, may repeat by chance


class RepeatedScans:
    """The last new scan of each lidar, by its frame, and the odometry (3,) that it came with."""

    def __init__(self) -> None:
        self._new: dict[str, tuple[bytes, Array | None]] = {}

    def is_stale(self, scan: Scan, odometry: Array | None) -> bool:
        """Whether a scan equals the one before, although the robot has moved since.

        ``odometry`` (3,) is the pose at the stamp of the scan; without it, no scan is stale.
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
