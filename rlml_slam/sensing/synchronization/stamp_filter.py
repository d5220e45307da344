# SPDX-License-Identifier: Apache-2.0
"""Removes the jitter of the stamps of a sensor that has a constant rate.

A driver that stamps data on arrival has the jitter of the transport, which is some centimetres at
the speed of the robot. The true times of a sensor with a constant rate are linear in the number of
the message. The line through the last WINDOW stamps gives the newest time with an error of
2 / sqrt(WINDOW) of the jitter; ``sigma`` is the error that remains.

The stamps show whether the rate is constant. White jitter gives intervals with twice the variance
of the stamps about the line; if the intervals themselves vary, times drift from any line, and the
variance about it is a multiple of that of the intervals. Jitter as long as the period makes stamps
overtake one another; if they never do, messages arrive in bursts. Exact stamps of messages that
overtake one another are equidistant when sorted. All such stamps stay unchanged.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import NamedTuple

import numpy as np

WINDOW = 400  # stamps that the line is laid through
FEW = 8  # stamps of a line that can show lost messages
ENOUGH = 32  # stamps before anything is said: intervals that vary have wandered off by then
# variance about the line per variance of the intervals; 0.5 is that of white jitter
STEADY = 0.6
UNSTEADY = 0.9  # no jitter: that of a clock that was steady is not above it
SMALL = 5e6  # [ns] at 1 m/s, jitter below this is less than the noise: the stamps stay as they are
OVERTAKES = 0.5  # of the expected number of stamps earlier than the one before
EVEN, MOST = 0.1, 0.8  # of stamps that jitter by a period, a fifth would be so even
OUTLIER = 5.0  # sigmas of the jitter: a stamp farther from the line is not on it
RESOLVED = 4.0  # sigmas of the jitter in a period: then a lost message shows
BACK = 100_000_000  # [ns] a stamp farther before the last one is of no jitter
LOST = 0.7  # periods that a stamp is late by at least where one is lost


class Line(NamedTuple):
    """Stamp = ``start`` + ``period`` number [ns], within ``sigma`` [ns].

    ``ratio`` is the variance about it per that of the intervals.
    """

    start: float
    period: float
    sigma: float
    ratio: float


class StampFilter:
    """The line through the newest stamps of one sensor, in whole nanoseconds."""

    def __init__(self) -> None:
        # [ns] error of the last stamp, 0 without jitter, and its white part
        self.sigma = self.white = 0.0
        self._restart()
        self._newest: tuple[int, int] | None = None  # last stamp, and the filtered one

    def _restart(self) -> None:
        self._stamps: deque[tuple[int, int]] = deque()  # number of the message, stamp
        self._now: Line | None = None  # the line through them
        self._first = 0
        self._is_steady = False
        self._lost = 0  # messages that seem lost before the newest
        # sums over the window of 1, k, k^2, s, k s, s^2, k being the number, s the stamp since
        # the first; and over its steps of n^2, n d, d^2
        self._sums = (0, 0, 0, 0, 0, 0)
        self._steps = (0, 0, 0)
        self._overtakes = 0

    def filtered(self, stamp: int) -> int:
        """The stamp [ns] without jitter, if the rate is constant; may be repeated for a stamp."""
        if self._newest is not None and stamp == self._newest[0]:
            return self._newest[1]
        if self._newest is not None and stamp < self._newest[0] - BACK:
            return stamp
        number = 0
        if self._stamps:
            number = self._stamps[-1][0] + 1
            if self._now is not None:
                number = self._numbered(stamp, number, self._now)
        self._add(number, stamp)
        self._now = line = self._line()
        out, self.sigma = stamp, 0.0
        if line is None or not self._is_jitter(line):
            self._is_steady = False
        else:
            limit = UNSTEADY if self._is_steady else STEADY
            self._is_steady = len(self._stamps) >= ENOUGH and line.ratio < limit
            self.sigma = line.sigma if line.sigma > SMALL else 0.0
        self.white = self.sigma
        if line is not None and self._is_steady and self.sigma:
            if self._lost:
                # a message was lost, or this one is late: the next stamp decides
                self.sigma = self.white = 0.5 * line.period
            else:
                out = self._first + round(line.start + line.period * number)
                self.sigma *= 2.0 / math.sqrt(len(self._stamps))
                self.white = 0.0
        self._newest = (stamp, out)
        return out

    def _numbered(self, stamp: int, number: int, line: Line) -> int:
        """The number of a stamp: that of the next message, or of a later one where some are lost.

        A stamp that is not on the line of a constant rate, or far from its end, starts a new line.
        """
        # A lost message that was not detected bends the line: its end and the jitter about it must
        # not hide further ones. The intervals and the newest stamps are not affected.
        sigma = max(line.sigma / max(math.sqrt(2.0 * line.ratio), 1.0), SMALL)
        ahead = self._off(line, number, stamp)
        if not self._is_steady:
            newest = itertools.islice(reversed(self._stamps), FEW)
            ahead -= sorted(self._off(line, k, s) for k, s in newest)[FEW // 2]
        if self._lost == 1 and ahead < -0.5 * line.period:
            # none was lost: the one before was late
            self._renumber_newest(number - 2)
            number -= 1
            ahead += line.period
        resolved = RESOLVED * sigma < line.period
        lost = 0
        if ahead > (LOST * line.period if resolved else OUTLIER * sigma):
            lost = round(ahead / line.period)
        off = abs(ahead - lost * line.period) > OUTLIER * sigma
        if (self._is_steady and off) or lost > WINDOW:
            self._restart()
            return 0
        self._lost = lost
        return number + lost

    def _off(self, line: Line, number: int, stamp: int) -> float:
        """How far a stamp is from a line [ns]."""
        return stamp - self._first - (line.start + line.period * number)

    def _renumber_newest(self, number: int) -> None:
        newest, before = self._stamps.pop(), self._stamps[-1]
        self._count(newest, before, newest, -1)
        self._append(number, newest[1])

    def _is_jitter(self, line: Line) -> bool:
        """Whether the stamps may be those of a constant rate with white jitter."""
        if line.ratio >= UNSTEADY or (line.sigma > SMALL and self._is_exact()):
            return False
        # two neighbours' jitter differs by a normal deviate of sqrt(2) sigma
        n = len(self._stamps)
        expected = 0.5 * n * math.erfc(0.5 * line.period / max(line.sigma, SMALL))
        return self._overtakes >= OVERTAKES * expected - 1.0

    def _is_exact(self) -> bool:
        """Whether the sorted stamps are equidistant: messages were lost or changed their order."""
        steps = np.diff(np.sort([stamp for _, stamp in self._stamps]))
        # some are still to come, so that a step may be of several periods
        periods = steps / max(float(np.median(steps)), 1.0)
        even = np.abs(periods - np.maximum(np.rint(periods), 1.0)) < EVEN
        return float(even.mean()) > MOST

    def _add(self, number: int, stamp: int) -> None:
        if not self._stamps:
            self._first = stamp
        self._append(number, stamp)
        if len(self._stamps) > WINDOW:
            oldest = self._stamps.popleft()
            self._count(oldest, oldest, self._stamps[0], -1)

    def _append(self, number: int, stamp: int) -> None:
        newest = (number, stamp)
        before = self._stamps[-1] if self._stamps else newest
        self._stamps.append(newest)
        self._count(newest, before, newest, 1)

    def _count(
        self, at: tuple[int, int], a: tuple[int, int], b: tuple[int, int], sign: int
    ) -> None:
        """Add to the sums, or take from them, a stamp and its step from ``a`` to ``b``."""
        k, s = at[0], at[1] - self._first
        n, sum_k, sum_kk, sum_s, sum_ks, sum_ss = self._sums
        signed = sign * s
        self._sums = (
            n + sign, sum_k + sign * k, sum_kk + sign * k * k,
            sum_s + signed, sum_ks + signed * k, sum_ss + signed * s,
        )  # fmt: skip
        m, d = b[0] - a[0], b[1] - a[1]
        self._overtakes += sign * (d < 0)
        nn, nd, dd = self._steps
        self._steps = (nn + sign * m * m, nd + sign * m * d, dd + sign * d * d)

    def _line(self) -> Line | None:
        """The line through the window; None with too few stamps, or if the clock stands still."""
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
