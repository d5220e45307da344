# SPDX-License-Identifier: Apache-2.0
"""Scans and detections that wait: for odometry, for each other, and for other lidars.

Nothing waits longer than ``odom_timeout``, but for odometry in two cases, measured by stamps,
never by a clock: a replay decides in the same way. Without a lidar, and after a gap in all
messages, a guess of the motion would decide what is seen, so odometry is awaited until it counts
as missing (``input_timeout``).
"""

from __future__ import annotations

from typing import NamedTuple

from rlml_slam.motion import SECOND
from rlml_slam.params import Parameters
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.stamp_check import StampCheck
from rlml_slam.types import Detections, Scan

PAIRING = 2_000_000  # [ns] stamps of one instant may differ by this: drivers round to milliseconds


class Waiting(NamedTuple):
    """A scan, or set of detections, measured ``delay`` [ns] after its stamp."""

    stamp: int
    stream: str
    item: Scan | Detections
    delay: int

    @property
    def end(self) -> int:
        """Time [ns] of its last ray."""
        sweep = sweep_time(self.item) if isinstance(self.item, Scan) else 0.0
        return self.item.stamp + max(self.delay, 0) + int(sweep * SECOND)


class WaitingQueue:
    """Waiting items in the order of their stamps; knows the periods of the lidars."""

    def __init__(self, params: Parameters, stamps: StampCheck, inputs: InputCounts) -> None:
        self._node = params.node
        self._stamps = stamps
        self._inputs = inputs
        self._timeout = int(params.node.odom_timeout * SECOND)
        self._health = params.health
        self._max_gap = int(params.motion.max_gap * SECOND)
        self._released = -(2**62)  # stamp of the last group
        self._items: list[Waiting] = []
        self._lidars: dict[str, tuple[int, int]] = {}  # by frame: newest stamp and period
        # stamp of the last observation that had, or should have had, scan and detections
        self._paired = -(2**62)

    def __len__(self) -> int:
        return len(self._items)

    @property
    def has_several_lidars(self) -> bool:
        """Whether scans came in more than one frame."""
        return len(self._lidars) > 1

    def note_lidar(self, scan: Scan) -> None:
        """Update the period of the lidar of a scan."""
        newest, period = self._lidars.get(scan.frame_id, (scan.stamp, 0))
        if scan.stamp > newest:
            newest, period = scan.stamp, scan.stamp - newest
        self._lidars[scan.frame_id] = (newest, period)

    def note_pair(self, stamp: int) -> None:
        """An instant had scan and detections: the next ones wait for each other."""
        self._paired = stamp

    def add(self, stream: str, item: Scan | Detections, delay: int) -> None:
        """Let a scan or set of detections wait."""
        self._items.append(Waiting(item.stamp, stream, item, delay))
        self._items.sort(key=lambda w: (w.stamp, w.stream))

    def drop_after(self, stamp: int, stream: str = '', frame_id: str = '') -> None:
        """Drop what is after a stamp [ns], of all streams or of a sensor of one."""
        self._items = [
            w for w in self._items
            if w.stamp <= stamp
            or w.stream != (stream or w.stream)
            or w.item.frame_id != (frame_id or w.item.frame_id)
        ]  # fmt: skip

    def pop(self, newest_odometry: int | None, flush: bool = False) -> list[Waiting]:
        """Items of the first instant, if they are ready, or if all are flushed; else none.

        At most one scan and one set of detections: the scan of a second lidar is the next
        observation.
        """
        if not self._items:
            return []
        stamp = self._items[0].stamp
        group: list[Waiting] = []
        for w in self._items:
            if w.stamp - stamp <= PAIRING and w.stream not in [g.stream for g in group]:
                group.append(w)
        if not flush and not self._is_ready(stamp, group, newest_odometry):
            return []
        self._items = [w for w in self._items if not any(w is g for g in group)]
        self._released = stamp
        return group

    def _is_ready(self, stamp: int, group: list[Waiting], newest_odometry: int | None) -> bool:
        end = max(w.end for w in group)
        waited = self._stamps.newest - end
        if waited > self._timeout and not self._is_in_pause(group, newest_odometry):
            self._inputs.count(group[0].stream, 'waited_out')
            return True
        if self._waits_for_odometry(end, newest_odometry):
            return False
        if self.has_several_lidars and self._is_lidar_due(stamp, group):
            return False
        return len(group) > 1 or not self._waits_for_pair(stamp, group[0].stream, waited)

    def _is_in_pause(self, group: list[Waiting], newest: int | None) -> bool:
        """Whether odometry pauses, but is not missing yet: without a lidar, or after a gap."""
        if newest is None or not self._node.use_odom:
            return False
        is_after_gap = group[0].stamp - max(newest, self._released) > self._max_gap
        if not is_after_gap and (self._lidars or any(w.stream == 'scan' for w in group)):
            return False
        begin = group[0].stamp if is_after_gap else newest
        return self._stamps.newest - begin <= int(self._health.input_timeout * SECOND)

    def _waits_for_odometry(self, end: int, newest: int | None) -> bool:
        """Whether odometry at ``end`` is still expected; none is, if none came in a second."""
        if not self._node.use_odom:
            return False
        return self._stamps.is_starting if newest is None else newest < end

    def _waits_for_pair(self, stamp: int, stream: str, waited: int) -> bool:
        """Whether detections for a scan, or a scan for detections, are still expected."""
        is_starting = self._stamps.first is None or stamp - self._stamps.first < SECOND
        if not is_starting and stamp - self._paired >= SECOND:
            return False
        other = 'reflectors' if stream == 'scan' else 'scan'
        return (self._stamps.newest_of(other) or 0) <= stamp and waited <= self._timeout // 2

    def _is_lidar_due(self, stamp: int, group: list[Waiting]) -> bool:
        """Whether another lidar, by its period, will send a scan that is before this one."""
        here = {w.item.frame_id for w in group if w.stream == 'scan'}
        return any(
            newest + period <= stamp + PAIRING and stamp - newest < SECOND
            for frame_id, (newest, period) in self._lidars.items()
            if period > 0 and frame_id not in here
        )
