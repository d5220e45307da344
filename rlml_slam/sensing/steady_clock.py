# SPDX-License-Identifier: Apache-2.0
"""Takes the jitter out of the stamps of a sensor that measures at a steady rate.

A stamp that a driver takes when the data have come jitters by what the transport does, at the
robot's speed some centimetres. The sensor itself is steady: its true times lie on a straight line
over the number of the message, and a line through the last WINDOW stamps tells the newest one with
an error of 2 / sqrt(WINDOW) of the jitter.

Whether a sensor is steady is asked of the stamps. White jitter makes the variance of the intervals
twice that about the line; where the intervals themselves vary, times wander off any line, and the
variance about it is a multiple of that of the intervals. And jitter as long as the period makes
stamps overtake one another: where they never do, messages come in bursts. Such stamps stay.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

WINDOW = 100  # stamps that the line is laid through
FEW = 8  # stamps through which a line tells whether messages were lost
ENOUGH = 32  # stamps before anything is said: intervals that vary have wandered off by then
# variance about the line per variance of the intervals; 0.5 is that of white jitter
STEADY = 0.6
UNSTEADY = 0.9  # of a clock that was steady
SMALL = 5e6  # [ns] at 1 m/s, jitter below this is less than the noise: the stamps stay as they are
OVERTAKES = 0.5  # of the expected number of stamps earlier than the one before
OUTLIER = 5.0  # sigmas of the jitter: a stamp farther from the line is not on it
RESOLVED = 4.0  # sigmas of the jitter in a period: then a lost message shows
LOST = 0.7  # periods that a stamp is late by at least where one is lost


class Line(NamedTuple):
    """Stamp = ``start`` + ``period`` number [ns], within ``sigma`` [ns].

    ``ratio`` is the variance about it per that of the intervals.
    """

    start: float
    period: float
    sigma: float
    ratio: float


class SteadyClock:
    """The line through the newest stamps of one sensor, in whole nanoseconds."""

    def __init__(self) -> None:
        self._restart()
        self._told: tuple[int, int] | None = None

    def _restart(self) -> None:
        self._stamps: deque[tuple[int, int]] = deque()  # number of the message, stamp
        self._first = 0
        self._is_steady = False
        # sums over the window of 1, k, k^2, s, k s, s^2, k being the number, s the stamp since
        # the first; and over its steps of n^2, n d, d^2
        self._sums = [0] * 6
        self._steps = [0] * 3
        self._overtakes = 0

    def steady(self, stamp: int) -> int:
        """The stamp [ns] less its jitter, if the sensor is steady; the same for the same one."""
        if self._told is not None and stamp == self._told[0]:
            return self._told[1]
        line = self._line()
        number = 0
        if self._stamps:
            number = self._stamps[-1][0] + 1
            if line is not None:
                number = self._numbered(stamp, number, line)
        self._add(number, stamp)
        line = self._line()
        self._is_steady = line is not None and self._is_jitter(line)
        out = stamp
        if line is not None and self._is_steady and line.sigma > SMALL:
            out = self._first + round(line.start + line.period * number)
        self._told = (stamp, out)
        return out

    def _numbered(self, stamp: int, number: int, line: Line) -> int:
        """The number of a stamp: that of the next message, or of a later one where some are lost.

        A stamp that is off a steady line, or far from its end, begins another one.
        """
        sigma = max(line.sigma, SMALL)
        ahead = stamp - self._first - (line.start + line.period * number)
        resolved = RESOLVED * sigma < line.period
        lost = 0
        if ahead > (LOST * line.period if resolved else OUTLIER * sigma):
            lost = round(ahead / line.period)
        off = abs(ahead - lost * line.period) > OUTLIER * sigma
        if (self._is_steady and off) or lost > WINDOW:
            self._restart()
            return 0
        return number + lost

    def _is_jitter(self, line: Line) -> bool:
        """Whether the stamps are those of a steady sensor and white jitter."""
        n = len(self._stamps)
        if n < ENOUGH or line.ratio >= (UNSTEADY if self._is_steady else STEADY):
            return False
        # two neighbours' jitter differs by a normal deviate of sqrt(2) sigma
        expected = 0.5 * n * math.erfc(0.5 * line.period / max(line.sigma, SMALL))
        return self._overtakes >= OVERTAKES * expected - 1.0

    def _add(self, number: int, stamp: int) -> None:
        if not self._stamps:
            self._first = stamp
        else:
            self._count_step(self._stamps[-1], (number, stamp), 1)
        self._stamps.append((number, stamp))
        self._count(number, stamp, 1)
        if len(self._stamps) > WINDOW:
            oldest = self._stamps.popleft()
            self._count(*oldest, -1)
            self._count_step(oldest, self._stamps[0], -1)

    def _count(self, k: int, stamp: int, sign: int) -> None:
        s = stamp - self._first
        for i, value in enumerate((1, k, k * k, s, k * s, s * s)):
            self._sums[i] += sign * value

    def _count_step(self, a: tuple[int, int], b: tuple[int, int], sign: int) -> None:
        n, d = b[0] - a[0], b[1] - a[1]
        self._overtakes += sign * (d < 0)
        for i, value in enumerate((n * n, n * d, d * d)):
            self._steps[i] += sign * value

    def _line(self) -> Line | None:
        """The line through the window, None through too few or those of a clock that stands."""
        n, k, kk, s, ks, ss = self._sums
        if n < FEW:
            return None
        # sums about the means, times n: integers, so nothing is lost to rounding
        kk, ks, ss = n * kk - k * k, n * ks - k * s, n * ss - s * s
        period = ks / kk
        if period <= 0.0:
            return None
        variance = (ss - ks * ks / kk) / (n * (n - 2))
        nn, nd, dd = self._steps
        of_steps = (dd - 2.0 * period * nd + period * period * nn) / (n - 1)
        ratio = variance / of_steps if of_steps > 0.0 else 0.0
        return Line(s / n - period * k / n, period, max(variance, 0.0) ** 0.5, ratio)
