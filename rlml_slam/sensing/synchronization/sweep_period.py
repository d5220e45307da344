# SPDX-License-Identifier: Apache-2.0
"""How much time there is between two sweeps of a laser, where its stamps tell when they came in.

A laser turns at a constant rate, so no two of its sweeps are much closer in time than its period.
Where stamps often say so, they are those of a transport that delivers in bursts. Odometry of the
same log came the same way and goes with them; to a robot without odometry, the period is what
was between two sweeps, and the stamps are off by as much as its speed makes of them.
"""

from __future__ import annotations

import math
from collections import deque

WINDOW = 50  # intervals that tell the period
ENOUGH = 20  # of them before anything is said
SHORT = 0.5  # share of the period that no sweep is shorter than
OFTEN = 0.1  # share of short intervals; jitter of a quarter of the period makes fewer


class SweepPeriod:
    """The newest intervals between the stamps of one laser, in seconds."""

    def __init__(self) -> None:
        self._intervals: deque[float] = deque(maxlen=WINDOW)

    def elapsed(self, dt: float) -> tuple[float, float]:
        """Time [s] between the last two sweeps, whose stamps differ by ``dt``, and its error.

        The error is 0 where the stamps tell the time. Else it is the spread of what they say: a
        sweep that was lost, or came after a later one, is not told from one that came late.
        """
        self._intervals.append(dt)
        n = len(self._intervals)
        period = sum(self._intervals) / n
        short = sum(interval < SHORT * period for interval in self._intervals)
        if n < ENOUGH or short <= OFTEN * n:
            return dt, 0.0
        spread = sum((interval - period) ** 2 for interval in self._intervals)
        return period, math.sqrt(spread / n)
