# SPDX-License-Identifier: Apache-2.0
"""Where the motion comes from: the odometry topic, or the transform odom to base on /tf.

On many robots a filter owns odom to base on /tf, and the wheels publish another estimate on the
topic. The motion is that of one of them at a time. Map to odom is computed against /tf in any
case, or map to base on /tf would be wrong by the difference of the two, which grows.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import SECOND
from rlml_slam.se2 import Array
from rlml_slam.types import Odometry

TOPIC, TF = 'odom', 'tf'  # streams
FRESH = SECOND  # [ns] of silence, after which the other source takes over
WINDOW = 10.0  # [s] over which the two sources are compared
# Two measurements of one motion: scale errors of 1 % each, 3 sigma; and what rounding, slip of a
# moment and stamps leave.
MOST_WAY, MOST_TURN = 0.04, 0.04  # shares of way and turn
LEAST_WAY, LEAST_TURN = 0.05, 0.005  # [m], [rad] in a window


class PoseHistory:
    """Poses (3,) by stamp of the last ``memory`` seconds, linear in between, as tf2 has them."""

    def __init__(self, memory: float) -> None:
        self._memory = int(memory * SECOND)
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    @property
    def newest(self) -> int | None:
        """Stamp of the newest pose, None before the first."""
        return self._stamps[-1] if self._stamps else None

    @property
    def first(self) -> int:
        """Stamp of the oldest pose."""
        return self._stamps[0]

    @property
    def last(self) -> Array:
        """The newest pose (3,)."""
        return self._poses[-1]

    def add(self, sample: Odometry) -> None:
        """Append a pose, unless it is no later than the newest one."""
        if self._stamps and sample.stamp <= self._stamps[-1]:
            return
        self._stamps.append(sample.stamp)
        self._poses.append(np.array(sample.pose, dtype=np.float64))
        if self._stamps[0] < sample.stamp - 2 * self._memory:
            k = bisect_left(self._stamps, sample.stamp - self._memory)
            del self._stamps[:k], self._poses[:k]

    def at(self, stamp: int) -> Array | None:
        """The pose (3,) at a stamp, None outside of what is known."""
        if not self._stamps or not self._stamps[0] <= stamp <= self._stamps[-1]:
            return None
        k = bisect_left(self._stamps, stamp)
        if self._stamps[k] == stamp:
            return self._poses[k]
        share = (stamp - self._stamps[k - 1]) / (self._stamps[k] - self._stamps[k - 1])
        a, b = self._poses[k - 1], self._poses[k]
        step = np.array([*(b - a)[:2], se2.wrapped(b[2] - a[2])])
        return a + share * step

    def forget_after(self, stamp: int) -> None:
        """Drop all poses later than a stamp: their clock was wrong."""
        k = bisect_right(self._stamps, stamp)
        del self._stamps[k:], self._poses[k:]


class OdometrySources:
    """Chooses the samples that are used as motion; remembers ``transforms``, those of /tf.

    ``wanted`` is the parameter odom_source: auto takes /tf as long as it has the transform. Where
    the source changes, the poses of the new one continue those of the old one.
    """

    def __init__(self, wanted: str, memory: float) -> None:
        self._wanted = wanted
        self.transforms = PoseHistory(memory)
        self._of = {TF: self.transforms, TOPIC: PoseHistory(memory)}
        self.source = ''
        self._offset: Array | None = None
        self._last: Odometry | None = None
        self.comparison = Comparison(self._of[TOPIC], self.transforms)

    def use(self, source: str, sample: Odometry) -> Odometry | None:
        """The sample as it continues the motion, None if it is not used for it."""
        history = self._of[source]
        history.add(sample)
        if source == TOPIC:
            self.comparison.update(sample.stamp)
        if not self._is_wanted(source, sample.stamp):
            return None
        if source != self.source and not self._switch(source, sample, history):
            return None
        if self._offset is not None:
            sample = Odometry(sample.stamp, se2.compose(self._offset, sample.pose))
        self._last = sample
        return sample

    def forget_after(self, stamp: int) -> None:
        """Drop all poses later than a stamp: their clock was wrong."""
        for history in self._of.values():
            history.forget_after(stamp)
        if self._last is not None and self._last.stamp > stamp:
            self.source, self._last, self._offset = '', None, None

    def forget_early(self, source: str, stamp: int) -> None:
        """Drop the poses of a source later than a stamp; the ones before it go on."""
        history = self._of[source]
        history.forget_after(stamp)
        if source == self.source and history.newest is not None:
            offset = np.zeros(3) if self._offset is None else self._offset
            self._last = Odometry(history.newest, se2.compose(offset, history.last))

    def newest(self, of_motion: int | None) -> int | None:
        """Stamp [ns] up to which the motion, and the transform where /tf has it, are known."""
        known = self.transforms.newest
        if of_motion is None or known is None or of_motion - known > FRESH:
            return of_motion
        return min(of_motion, known)

    def _is_wanted(self, source: str, stamp: int) -> bool:
        if self._wanted != 'auto':
            return self._wanted == ('tf' if source == TF else 'topic')
        newest = self.transforms.newest
        return source == TF or newest is None or stamp - newest > FRESH

    def _switch(self, source: str, sample: Odometry, history: PoseHistory) -> bool:
        """Take over from the other source; False where the two do not overlap yet."""
        if self._last is not None:
            before = history.at(self._last.stamp)
            if before is None and sample.stamp - self._last.stamp < FRESH:
                return False
            self._offset = (
                None if before is None else se2.compose(self._last.pose, se2.inverse(before))
            )
        self.source = source
        return True


class Comparison:
    """How far two measurements of the same motion are apart, by windows of WINDOW seconds.

    ``way`` is the share of the way, ``turn`` [rad/s] the rate by which the headings drift apart;
    ``differ`` says whether that is more than two calibrated sensors may.
    """

    def __init__(self, a: PoseHistory, b: PoseHistory) -> None:
        self._of = a, b
        self._start = self._stamp = 0
        self._before: tuple[Array, Array] | None = None
        self._moved = np.zeros((2, 2))  # by source: way ahead and turn
        self._travelled = np.zeros(2)  # the same without signs
        self.way = self.turn = math.nan
        self.differ = False

    def __str__(self) -> str:
        """In words; empty as long as there is nothing to compare."""
        if math.isnan(self.way):
            return ''
        turn = 60.0 * math.degrees(self.turn)
        return f'{self.way:.1%} of the way, {turn:.1f} degrees per minute'

    def update(self, stamp: int) -> None:
        """Compare up to a stamp [ns], or up to where both are known."""
        stamp = min(stamp, *(h.newest or 0 for h in self._of))
        a, b = (h.at(stamp) for h in self._of)
        if a is None or b is None or stamp <= self._stamp:
            return
        if self._before is None or stamp - self._stamp > FRESH:
            self._restart(stamp)
        else:
            steps = [
                se2.log(se2.between(before, pose))[[0, 2]]
                for before, pose in zip(self._before, (a, b), strict=True)
            ]
            self._moved += steps
            self._travelled += np.abs(steps[0])
        self._before, self._stamp = (a, b), stamp
        if stamp - self._start >= WINDOW * SECOND:
            way, turn = np.abs(self._moved[0] - self._moved[1])
            length, turned = self._travelled
            self.way, self.turn = way / max(length, LEAST_WAY), turn / WINDOW
            self.differ = bool(
                way > LEAST_WAY + MOST_WAY * length or turn > LEAST_TURN + MOST_TURN * turned
            )
            self._restart(stamp)

    def _restart(self, stamp: int) -> None:
        self._start = stamp
        self._moved, self._travelled = np.zeros((2, 2)), np.zeros(2)
