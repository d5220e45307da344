# SPDX-License-Identifier: Apache-2.0
"""Whether the gyro turns as odometry does: the faults of a set-up that would ruin good odometry.

The motion has the turn of the gyro, in the place of that of the wheels. These slip, so that only
what no slip looks like for long is a fault, and only where the scans do not contradict them.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import SECOND
from rlml_slam.se2 import Array
from rlml_slam.types import Imu

TURN = 0.3  # [rad] of odometry, at which a window ends
SETTLE = SECOND // 5  # [ns] after that: clocks differ
LONGEST = 10 * SECOND  # [ns] of a window: in a longer one the bias of the gyro counts
GAP = SECOND // 4  # [ns] between turn rates, and from the newest of them to odometry
MEMORY = 40  # windows that are remembered
ENOUGH, MOST = 2, 0.8  # windows, and share of those remembered, that show one fault
AGREE = 0.3, 1.7  # turn of the scans, which come later, as a share of that of odometry
DEGREES = math.degrees(1.0)
FAULTS = {  # turn of the gyro, as a share of that of odometry
    'it measures nothing': (-0.1, 0.1),
    'its sign is wrong: is its frame on /tf_static?': (-1.2, -0.8),
    'it is in degrees per second': (0.8 * DEGREES, 1.2 * DEGREES),
}


class GyroCheck:
    """Compares turns of the robot; ``fault`` is what is wrong with the gyro, '' if nothing is.

    ``error`` is the message for the log, with figures.
    """

    def __init__(self) -> None:
        self.fault = self.error = ''
        self._imu: Imu | None = None
        self._stamp = 0  # [ns] of the newest odometry
        self._headings = np.full(3, np.nan)  # the newest, as far as there are any
        self._turns = np.zeros(3)  # [rad] of gyro, odometry and scans since the beginning
        self._before: Array | None = None  # the same at the beginning of the window
        self._begin = self._reached = 0  # stamps [ns]: of that, and until which it turned less
        self._found: deque[str] = deque(maxlen=MEMORY)  # by window, '' for no fault

    def restart(self) -> None:
        """Begin a new window: odometry jumped."""
        self._before = None

    def add_imu(self, sample: Imu) -> None:
        """Integrate the turn rate."""
        last, self._imu = self._imu, sample
        if last is None or not 0 <= sample.stamp - last.stamp <= GAP:
            self.restart()
        else:
            mean = 0.5 * (last.yaw_rate + sample.yaw_rate)
            self._turns[0] += mean * (sample.stamp - last.stamp) / SECOND

    def add_pose(self, heading: float) -> None:
        """Heading [rad] of a pose that scans or reflectors corrected."""
        self._turn(2, heading)

    def add_odometry(self, stamp: int, heading: float) -> None:
        """One sample: its stamp [ns] and heading [rad]; compared at the end of a window."""
        self._turn(1, heading)
        step, self._stamp, imu = stamp - self._stamp, stamp, self._imu
        if imu is None or not 0 <= step <= SECOND or abs(stamp - imu.stamp) > GAP:
            self.restart()
            return
        now = self._turns.copy()
        now[0] += imu.yaw_rate * (stamp - imu.stamp) / SECOND
        if self._before is None or stamp - self._begin > LONGEST:
            self._before, self._begin, self._reached = now, stamp, stamp
        turns = now - self._before
        if abs(turns[1]) < TURN:
            self._reached = stamp
        elif stamp - self._reached >= SETTLE:
            self._compare(*turns.tolist())
            self.restart()

    def _turn(self, k: int, heading: float) -> None:
        turn = se2.wrapped(heading - self._headings[k])
        if math.isfinite(turn):
            self._turns[k] += turn
        self._headings[k] = heading

    def _compare(self, gyro: float, odometry: float, scans: float) -> None:
        seen = not scans or AGREE[0] < scans / odometry < AGREE[1]
        faults = [f for f, (a, b) in FAULTS.items() if seen and a < gyro / odometry < b]
        self._found.append(faults[0] if faults else '')
        fault, n = Counter(self._found).most_common(1)[0]
        self.fault = fault if n >= max(ENOUGH, MOST * len(self._found)) else ''
        if fault in faults:
            self.error = f'imu: it turned by {gyro:.2f} rad where odometry turned by '
            self.error += f'{odometry:.2f} rad: it is not used, as {fault}'
