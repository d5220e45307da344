# SPDX-License-Identifier: Apache-2.0
"""The scans of a run, thinned to a fixed amount of memory: what a viewer shows at its cursor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array

MAX_SCANS = 1200  # every second one is dropped whenever there are as many
MAX_POINTS = 270  # of a scan: every fourth of a usual laser with 1080
UNIT = 0.01  # [m] of a coordinate, kept in 16 bits: up to 327 m


class ScanLog:
    """At most MAX_SCANS scans, evenly spread over the run, of at most MAX_POINTS points each."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.points: list[NDArray[np.int16]] = []
        self._stride = 1
        self._count = 0

    def __len__(self) -> int:
        return len(self.stamps)

    def is_due(self) -> bool:
        """Whether the next scan is kept: whether ``add`` or ``skip`` comes next."""
        return self._count % self._stride == 0

    def skip(self) -> None:
        """Count a scan that is not kept."""
        self._count += 1

    def add(self, stamp: int, points: Array) -> None:
        """Note end points (n, 2) [m] in the base frame at the stamp [ns], if it is their turn."""
        is_due = self.is_due()
        self.skip()
        if not is_due:
            return
        self.stamps.append(stamp)
        self.points.append(thinned(points))
        if len(self.stamps) > MAX_SCANS:
            del self.stamps[1::2]
            del self.points[1::2]
            self._stride *= 2


def thinned(points: Array) -> NDArray[np.int16]:
    """At most MAX_POINTS of the points (n, 2) [m], evenly spread, in UNIT; none beyond 327 m."""
    limit = np.iinfo(np.int16).max * UNIT
    near = points[(np.abs(points) < limit).all(axis=1)]
    step = -(-len(near) // MAX_POINTS) or 1
    return np.round(near[::step] / UNIT).astype(np.int16)
