# SPDX-License-Identifier: Apache-2.0
"""Whether the pose moves as odometry does: a misplaced laser, odometry that stands still.

Scans that are moved by a wrong transform still fit each other, so that their map and the pose in
it look right: behind a laser that faces backwards, the robot drives backwards; below one that is
upside down, it turns the other way.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import SECOND
from rlml_slam.se2 import Array
from rlml_slam.types import Motion

TRAVEL, TURN = 1.0, 0.5  # [m] of odometry or the pose, [rad] of odometry: there a window ends
MIN_TRAVEL, MIN_TURN = 0.5, 0.25  # [m], [rad] that are compared
STANDS = 0.3  # share of the travel below which wheels may have slipped, which is no such fault
FROZEN = 0.1  # travel of odometry, as a share of that of the pose, below which it stands still
AWAY = math.radians(60.0)  # between the travel of the pose and of odometry
AGAINST = -0.5  # turn of the pose, as a share of that of odometry
HALF_TURN = 2.5  # [rad] of odometry in a window, beyond which turns cannot be compared
LONGEST = 20 * SECOND  # [ns] of a window: in a longer one the bias of a gyro counts
MEMORY, ENOUGH, MOST = 5, 3, 0.8  # windows: remembered, needed, and the share that shows a fault
CLEAN = 10  # windows in a row without a fault of the mounting, after which there is none


class Windows:
    """Whether the last windows show a fault: most do, and then until ``clean`` in a row do not.

    A pose that follows wrong odometry for a while agrees with it. ``worst`` are their values.
    """

    def __init__(self, is_fault: Callable[[float], bool], clean: int) -> None:
        self._is_fault, self._clean = is_fault, clean
        self._shown: deque[bool] = deque(maxlen=MEMORY)
        self._num_clean = 0  # in a row
        self.worst: deque[float] = deque(maxlen=MEMORY)
        self.show_fault = False

    def add(self, value: float) -> None:
        """The value of the next window."""
        is_fault = self._is_fault(value)
        self._shown.append(is_fault)
        self._num_clean = 0 if is_fault else self._num_clean + 1
        if is_fault:
            self.worst.append(value)
        if sum(self._shown) >= max(ENOUGH, MOST * len(self._shown)):
            self.show_fault = True
        elif self._num_clean >= self._clean:
            self.show_fault = False


class LaserCheck:
    """Compares the pose with odometry, window by window."""

    def __init__(self) -> None:
        self._way = np.zeros(3)  # of odometry since the beginning of the window
        self._begin: Array | None = None  # pose (3,) there
        self._since = self._stamp = 0  # [ns] of that pose and of the newest motion
        # angle [rad] between the travels; turn of the pose as a share of odometry's
        self._angles = Windows(lambda angle: abs(angle) > AWAY, CLEAN)
        self._shares = Windows(lambda share: share < AGAINST, CLEAN)
        self._travels = Windows(lambda share: share < FROZEN, 1)  # of odometry's and the pose's

    def add_motion(self, stamp: int, motion: Motion) -> None:
        """What odometry measured since the last pose, until a stamp [ns]."""
        self._stamp = stamp
        if motion.known and stamp - self._since <= LONGEST:
            self._way = se2.compose(self._way, motion.delta)
        else:
            self._begin = None

    def fault(self, pose: Array) -> str:
        """What is wrong by all windows until now; the pose (3,) is that of the same moment."""
        moved = np.zeros(3) if self._begin is None else se2.between(self._begin, pose)
        travel = max(math.hypot(*self._way[:2]), math.hypot(*moved[:2]))
        if self._begin is None or travel >= TRAVEL or abs(self._way[2]) >= TURN:
            if self._begin is not None:
                self._compare(moved)
            self._begin, self._way, self._since = pose.copy(), np.zeros(3), self._stamp
        if self._angles.show_fault:
            angle = math.degrees(float(np.median(np.abs(self._angles.worst))))
            return (
                f'the pose moves {angle:.0f} deg away from where odometry goes: '
                'does the laser look where its transform says?'
            )
        if self._shares.show_fault:
            return (
                'the pose turns against odometry: is the laser upside down, or odometry mirrored?'
            )
        if self._travels.show_fault:
            return 'the pose moves while odometry stands still'
        return ''

    def _compare(self, moved: Array) -> None:
        (x, y, turn), way = moved.tolist(), math.hypot(*self._way[:2])
        if way >= MIN_TRAVEL and math.hypot(x, y) >= STANDS * way:
            self._angles.add(
                float(se2.wrap(math.atan2(y, x) - math.atan2(self._way[1], self._way[0])))
            )
        if math.hypot(x, y) >= MIN_TRAVEL:
            self._travels.add(way / math.hypot(x, y))
        if MIN_TURN <= abs(self._way[2]) <= HALF_TURN:
            self._shares.add(turn / float(self._way[2]))
