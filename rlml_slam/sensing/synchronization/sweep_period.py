# SPDX-License-Identifier: Apache-2.0
"""Time between two sweeps of a laser whose stamps are times of arrival.

A laser turns at a constant rate, so that its sweeps are never much closer than its period. Stamps
that often are closer come from a transport that delivers in bursts. Odometry of the same log was
delivered in the same way and matches the stamps; without odometry, the mean period is the better
estimate of the time between two sweeps.
"""

from __future__ import annotations

import math
from collections import deque

WINDOW = 50  # intervals whose mean is the period
ENOUGH = 20  # of them before anything is said
SHORT = 0.5  # share of the period that no sweep is shorter than
OFTEN = 0.1  # share of short intervals; jitter of a quarter of the period makes fewer


class SweepPeriod:
    """The newest intervals between the stamps of one laser, in seconds."""

    def __init__(self) -> None:
        self._intervals: deque[float] = deque(maxlen=WINDOW)

    def elapsed(self, dt: float) -> tuple[float, float]:
        """Time [s] between the last two sweeps, whose stamps differ by ``dt``, and its error.

        The error is 0 if the stamps are used. Else it is the spread of the intervals: a lost
        sweep, or one that was overtaken, is not distinguished from a late one.
        """
        self._intervals.append(dt)
        n = len(self._intervals)
        period = sum(self._intervals) / n
        short = sum(interval < SHORT * period for interval in self._intervals)
        if n < ENOUGH or short <= OFTEN * n:
            return dt, 0.0
        spread = sum((interval - period) ** 2 for interval in self._intervals)
        return period, math.sqrt(spread / n)
