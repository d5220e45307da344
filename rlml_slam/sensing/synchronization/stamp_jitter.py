# SPDX-License-Identifier: Apache-2.0
"""Clocks of the sensors: removes the jitter of stamps, one filter per clock."""

from __future__ import annotations

import math
from collections import defaultdict, deque

from rlml_slam.motion import SECOND
from rlml_slam.sensing.synchronization.stamp_filter import StampFilter
from rlml_slam.sensing.synchronization.waiting_queue import PAIRING

MEMORY = 20  # instants remembered: the second half of an instant comes soon after the first


class StampJitter:
    """Filters of all clocks: of odometry, of the IMU, and of each sensor of scans."""

    def __init__(self, enabled: bool) -> None:
        self._enabled = enabled
        self._filters: defaultdict[tuple[str, str], StampFilter] = defaultdict(StampFilter)
        # stamps of scans and detections, and their delays
        self._instants: deque[tuple[int, int]] = deque(maxlen=MEMORY)

    def filtered(self, stream: str, stamp: int, source: str = '') -> int:
        """The stamp [ns] without jitter, if the sensor has a constant rate."""
        if not self._enabled or stamp <= 0:
            return stamp
        return self._filters[stream, source].filtered(stamp)

    def restart(self, clock: tuple[str, str] | None = None) -> None:
        """Begin the filter of a clock (stream, source), or of all, again: stamps were wrong."""
        if clock is None:
            self._filters.clear()
        else:
            self._filters.pop(clock, None)

    def delay(self, stamp: int, source: str) -> int:
        """Time [ns] from the stamp of a scan, or set of detections, to its measurement.

        The stamp stays the name of the observation. Scan and detections of one instant have one
        clock, and the same delay.
        """
        for other, delay in self._instants:
            if abs(other - stamp) <= PAIRING:
                return delay
        delay = self.filtered('instant', stamp, source) - stamp
        self._instants.append((stamp, delay))
        return delay

    def errors(self, source: str, odometry: str) -> tuple[float, float]:
        """Errors [s], 1 sigma, of the time between scan and odometry: all, and its white part."""
        clocks = (self._filters.get((odometry, '')), self._filters.get(('instant', source)))
        known = [c for c in clocks if c is not None]
        return (
            math.hypot(*(c.sigma for c in known)) / SECOND,
            math.hypot(*(c.white for c in known)) / SECOND,
        )
