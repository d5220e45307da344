# SPDX-License-Identifier: Apache-2.0
"""How late odometry is stamped against scans and reflectors, from turns that both measured.

A driver that stamps what a controller sent some time ago is late; one that stamps a scan when all
of it has arrived makes odometry early. Where the turn rate changes, the turn between two poses of
the scans is that of the odometry at one delay only.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import SECOND

GRID = np.arange(-30, 31) * (SECOND // 100)  # [ns] delays that are compared
SHORTEST, LONGEST = 150_000_000, SECOND  # [ns] between two poses
LIMIT = 0.05  # [rad] what a difference counts at most: a wrong pose, wheels that slip
TELLING = 0.03  # [rad] by which a turn that counts varies over the grid: noise is less
MEMORY = 300  # turns after which one counts for 1 / e
ENOUGH = 40  # turns before anything is said
SURE = 0.7  # of the sum at the present delay: at a better one, it is at most that
KEPT = 5 * SECOND  # [ns] of odometry, where no poses come


class OdometryDelay:
    """Compares turns of the robot; ``now`` [ns] is the delay that is found."""

    def __init__(self) -> None:
        self.now = 0
        self._odometry: deque[tuple[int, float]] = deque()  # stamp [ns], heading without wraps
        self._poses: deque[tuple[int, float]] = deque(maxlen=100)
        self._sums, self._num = np.zeros(len(GRID)), 0.0  # over the turns, by delay

    def __str__(self) -> str:
        least = 'at least ' if abs(self.now) >= GRID[-1] else ''
        return f'{"late" if self.now > 0 else "early"} by {least}{abs(self.now) / SECOND:.2f} s'

    def add_odometry(self, stamp: int, heading: float) -> None:
        """One sample: its stamp [ns] as it came, and its heading [rad]."""
        if self._odometry and stamp <= self._odometry[-1][0]:
            self._odometry.clear()
            self._poses.clear()
        last = self._odometry[-1][1] if self._odometry else heading
        self._odometry.append((stamp, last + se2.wrapped(heading - last)))
        oldest = max((self._poses[0][0] if self._poses else stamp) + GRID[0], stamp - KEPT)
        while len(self._odometry) > 2 and self._odometry[1][0] < oldest:
            self._odometry.popleft()

    def add_pose(self, stamp: int, heading: float) -> None:
        """One pose of the scans at a stamp [ns]; compared when odometry is there."""
        if self._poses and 0 <= stamp - self._poses[-1][0] < SHORTEST:
            return
        self._poses.append((stamp, heading))
        while len(self._poses) > 1 and self._odometry and self._is_reached(self._poses[1][0]):
            (start, before), (end, after) = self._poses.popleft(), self._poses[0]
            if 0 < end - start < LONGEST and self._odometry[0][0] <= start + GRID[0]:
                self._compare(start, end, after - before)

    def _is_reached(self, stamp: int) -> bool:
        return self._odometry[-1][0] >= stamp + int(GRID[-1])

    def _compare(self, start: int, end: int, turn: float) -> None:
        stamps, headings = np.array(self._odometry).T
        turns = np.interp(GRID + end, stamps, headings) - np.interp(GRID + start, stamps, headings)
        if np.ptp(turns) < TELLING:
            return
        cost = np.minimum(se2.wrap(turn - turns) ** 2, LIMIT**2)
        keep = 1.0 - 1.0 / MEMORY
        self._sums, self._num = keep * self._sums + cost, keep * self._num + 1.0
        best = int(np.argmin(self._sums))
        if self._num > ENOUGH and self._sums[best] < SURE * self._sums[self.now == GRID][0]:
            self.now = int(GRID[best])
