# SPDX-License-Identifier: Apache-2.0
"""Inputs in any order become observations in the order of their stamps.

A scan waits for the odometry that covers its last ray, and for the detections of the same stamp
where those have come so far; nothing waits longer than ``transform_timeout``. All of it is decided
by stamps and order of arrival alone, never by a clock, so a replay repeats it exactly. Stamps of
steady sensors that jitter are made steady first.

Several lidars are told apart by their frames. Each scan is an observation of its own; a scan waits
for those of the others that are due before it, so that no lidar makes another one late.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.motion import SECOND, STILL, MotionBuffer, compose_motion
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import project, sweep_time
from rlml_slam.sensing.detection_frames import placed
from rlml_slam.sensing.no_return import NoReturnRanges
from rlml_slam.sensing.repeated_scans import RepeatedScans
from rlml_slam.sensing.synchronization.stamp_filter import StampFilter
from rlml_slam.types import Detections, Imu, Motion, Observation, Odometry, Scan

PAIRING = 2_000_000  # [ns] stamps of one instant: drivers round to milliseconds
CARRY = 5 * SECOND  # motion older than this is summed up; an observation later than it is late
MAX_SWEEP = 1.0  # [s] of one scan
INSTANTS = 20  # instants remembered: the other half of one comes soon after
AHEAD = SECOND  # a stamp this far before all others is strange; sensors lag by less
CONFIRM = 3  # messages that tell whether time did go on where a stamp is strange
PERSISTENT = 10  # inputs in a row that are behind: fewer are late, more are of a new clock
# stamp, stream, what came, and how much later than its stamp it was measured [ns]
Message: TypeAlias = Odometry | Imu | Scan | Detections
Waiting: TypeAlias = tuple[int, str, Scan | Detections, int]


@dataclass
class Inputs:
    """What became of the inputs, by stream: used, late, duplicate, future, invalid, waited_out.

    Of those used, ``no_returns`` are scans in which no beam came back; ``repeated`` ones, which
    the robot has moved on from, are left out.
    """

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    last_error: str = ''
    first_errors: dict[str, str] = field(default_factory=dict)

    def count(self, stream: str, what: str, error: str = '') -> None:
        """One more input of ``stream`` that was ``what``."""
        if stream not in self.counts:
            self.counts[stream] = Counter()
        self.counts[stream][what] += 1
        if error:
            self.last_error = error
            self.first_errors.setdefault(stream, error)

    def totals(self) -> dict[str, dict[str, int]]:
        """Plain dictionaries, sorted, for reports."""
        return {k: dict(sorted(v.items())) for k, v in sorted(self.counts.items())}


class Synchronizer:
    """Collects the inputs of one robot; each ``add_…`` returns the observations that became ready.

    An invalid input is counted in ``inputs`` and left out; it costs nothing that was known before.
    Only one thing raises InputError: stamps that stay behind, as a looped bag's do; the caller
    then starts anew.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._node = params.node
        self.inputs = Inputs()
        self.buffer = MotionBuffer(params.motion, self._node.tf_buffer_duration)
        self._timeout = int(self._node.transform_timeout * SECOND)
        self._sensor_poses: dict[str, Array] = {self._node.base_frame: np.zeros(3)}
        self._default_frame: dict[str, str] = {}
        self._waiting: list[Waiting] = []
        self._clocks: dict[tuple[str, str], StampFilter] = {}
        # stamps of scans and detections, and how much later they were measured
        self._instants: deque[tuple[int, int]] = deque(maxlen=INSTANTS)
        self._newest: dict[str, int] = {}
        self._newest_of: dict[tuple[str, str], int] = {}
        self._lidars: dict[str, tuple[int, int]] = {}  # by frame: newest stamp and period
        self._no_returns = NoReturnRanges()
        self._repeats = RepeatedScans()
        self._newest_any = -(2**62)
        self._first_any: int | None = None
        self._step: dict[str, int] = {}  # by stream: between its last two stamps
        self._num_behind = 0  # messages in a row whose stamp is far behind
        self._parked: list[tuple[str, Message]] = []  # put aside, their stamps far ahead
        self._num_passed = 0  # messages since that were not
        self._add: dict[str, Callable[[Any], list[Observation]]] = {
            'odom': self.add_odometry,
            'imu': self.add_imu,
            'scan': self.add_scan,
            'reflectors': self.add_detections,
        }
        self._last: int | None = None  # stamp up to which motion is used or carried
        self._carried = STILL
        self._white = 0.0  # [s] error of the last stamp that is not of the next
        # stamp of the last observation that had, or should have had, scan and detections
        self._paired = -(2**62)

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Where a sensor sits; without it the parameter ``laser_pose`` is used."""
        self._sensor_poses[frame_id] = np.asarray(T_base_sensor, dtype=np.float64)

    def add_odometry(self, sample: Odometry) -> list[Observation]:
        """One wheel odometry sample."""
        if not self._node.use_odom:
            return []
        if self._parks('odom', sample):
            return self._release()
        stamp = self._steady('odom', '', sample.stamp)
        sample = sample if stamp == sample.stamp else Odometry(stamp, sample.pose)
        valid = np.shape(sample.pose) == (3,) and all(map(math.isfinite, sample.pose))
        if self._accept('odom', sample.stamp, valid, 'pose is not finite'):
            self.buffer.add_odometry(sample)
            self._carry(sample.stamp)
            self.inputs.count('odom', 'used')
        return self._release()

    def add_imu(self, sample: Imu) -> list[Observation]:
        """One IMU sample."""
        if not self._node.use_imu:
            return []
        if self._parks('imu', sample):
            return self._release()
        stamp = self._steady('imu', '', sample.stamp)
        sample = sample if stamp == sample.stamp else Imu(stamp, sample.yaw_rate)
        if self._accept('imu', stamp, math.isfinite(sample.yaw_rate), 'rate is not finite'):
            self.buffer.add_imu(sample)
            self.inputs.count('imu', 'used')
        return self._release()

    def add_scan(self, scan: Scan) -> list[Observation]:
        """One sweep; used for its stamp alone where ``use_scan`` is false."""
        if self._parks('scan', scan):
            return self._release()
        n = len(scan.ranges)
        geometry = (scan.angle_min, scan.angle_increment, scan.time_increment, scan.range_max)
        if n == 0:
            self.inputs.count('scan', 'invalid', f'scan at {scan.stamp} ns is empty')
        elif not np.all(np.isfinite(geometry)) or scan.angle_increment == 0.0:
            self.inputs.count('scan', 'invalid', f'scan at {scan.stamp} ns has no valid geometry')
        elif not 0.0 <= sweep_time(scan) <= MAX_SWEEP:
            # waiting for the odometry at the end of such a sweep would hold up all that follows
            error = f'scan at {scan.stamp} ns: time_increment {scan.time_increment:g} s times {n} '
            self.inputs.count(
                'scan', 'invalid', error + f'beams is no sweep of 0 to {MAX_SWEEP} s'
            )
        elif self._known_frame('scan', scan.frame_id) and self._accept(
            'scan', scan.stamp, source=scan.frame_id
        ):
            self._note_lidar(scan)
            self._wait(scan.stamp, 'scan', self._no_returns.left_out(scan))
        return self._release()

    def add_detections(self, detections: Detections) -> list[Observation]:
        """The reflectors of one instant."""
        if not self._node.use_reflectors:
            return []
        if self._parks('reflectors', detections):
            return self._release()
        d = detections
        finite = np.isfinite(d.points).all() and np.isfinite(d.cov).all()
        if self._known_frame('reflectors', d.frame_id) and self._accept(
            'reflectors', d.stamp, bool(finite), 'a point or covariance is not finite'
        ):
            self._wait(d.stamp, 'reflectors', d)
        return self._release()

    def _steady(self, stream: str, source: str, stamp: int) -> int:
        """The stamp less its jitter, where the stream is one of a steady sensor."""
        if not self._node.filter_stamps or stamp <= 0:
            return stamp
        clock = self._clocks.get((stream, source))
        if clock is None:
            clock = self._clocks[stream, source] = StampFilter()
        return clock.steady(stamp)

    def _clock_of(self, item: Scan | Detections) -> tuple[str, str]:
        """Both halves of an instant have one clock, whichever comes first."""
        return 'instant', item.frame_id if len(self._lidars) > 1 else ''

    def _measured_later(self, stream: str, item: Scan | Detections) -> int:
        """How much later than its stamp a scan, or set of detections, was measured [ns].

        The stamp names it from here to the map, and stays; both of one instant were measured then.
        """
        for stamp, later in self._instants:
            if abs(stamp - item.stamp) <= PAIRING:
                return later
        later = self._steady(*self._clock_of(item), item.stamp) - item.stamp
        self._instants.append((item.stamp, later))
        return later

    def flush(self) -> list[Observation]:
        """Everything that still waits, at the end of the data."""
        return self._release(lambda _stamp, _end: True)

    def _known_frame(self, stream: str, frame_id: str) -> bool:
        """Whether the sensor's pose is known; the first unknown frame gets ``laser_pose``."""
        if frame_id in self._sensor_poses:
            return True
        if self._default_frame.setdefault(stream, frame_id) == frame_id:
            return True
        error = f'{stream} in frame {frame_id!r}, whose pose in {self._node.base_frame} is unknown'
        self.inputs.count(stream, 'invalid', error)
        return False

    def _sensor_pose(self, frame_id: str) -> Array:
        return self._sensor_poses.get(frame_id, np.array(self._node.laser_pose))

    def _note_lidar(self, scan: Scan) -> None:
        newest, period = self._lidars.get(scan.frame_id, (scan.stamp, 0))
        if scan.stamp > newest:
            newest, period = scan.stamp, scan.stamp - newest
        self._lidars[scan.frame_id] = (newest, period)

    def _accept(
        self, stream: str, stamp: int, valid: bool = True, why: str = '', source: str = ''
    ) -> bool:
        """Count and refuse what is invalid, duplicate, or older than what is already used."""
        if not valid or stamp <= 0:
            error = f'{stream} at {stamp} ns: {why or "stamp is not positive"}'
            self.inputs.count(stream, 'invalid', error)
            return False
        if stamp == self._newest_of.get((stream, source)):
            self.inputs.count(stream, 'duplicate')
            return False
        self._look_back(stream, stamp)
        newest = self._newest.get(stream)
        measured = stream in ('scan', 'reflectors')
        limit = self._last if measured else newest
        if limit is not None and stamp <= limit:
            self.inputs.count(stream, 'late', f'{stream} at {stamp} ns is late')
            if measured and stamp == self._last:
                self._paired = stamp  # the next one's other half will be waited for
            return False
        newest_of = self._newest_of.get((stream, source))
        self._step[stream] = 0 if newest is None else max(stamp - newest, 0)
        self._newest[stream] = stamp if newest is None else max(newest, stamp)
        self._newest_of[stream, source] = stamp if newest_of is None else max(newest_of, stamp)
        self._newest_any = max(self._newest_any, stamp)
        if self._first_any is None:
            self._first_any = stamp
        return True

    def _parks(self, stream: str, message: Message) -> bool:
        """Whether a message is put aside, for its stamp is too far ahead of all others.

        One that is believed makes all that come after it late. Where the others go on as before,
        it is left out; where it is followed by more of its kind, time did go on.
        """
        stamp = message.stamp
        ahead = stamp - self._newest_any
        if self._first_any is not None and ahead > AHEAD + 3 * self._step.get(stream, 0):
            self._parked.append((stream, message))
            self._num_passed = 0
            return True
        if self._parked and stamp > self._newest.get(stream, stamp):
            self._num_passed += 1
        return False

    def _unpark(self, least: int) -> list[Observation]:
        """Take in what was put aside, once it shows what is right; ``least`` of it say so.

        Where the others went on, it is what they have caught up with; the rest is left out.
        """
        others = self._num_passed >= CONFIRM
        if not self._parked or (len(self._parked) < least and not others):
            return []
        parked, self._parked, self._num_passed = self._parked, [], 0
        if not others:
            self._newest_any = max(self._newest_any, parked[0][1].stamp)
        out = []
        for stream, message in parked:
            ahead = message.stamp - self._newest_any
            if ahead <= AHEAD or not others:
                out += self._add[stream](message)
            else:
                error = f'{stream} at {message.stamp} ns is {ahead / SECOND:.1f} s ahead of all '
                self.inputs.count(stream, 'future', error + 'other stamps')
        return out

    def _look_back(self, stream: str, stamp: int) -> None:
        """Find out which is right where stamps are far behind the newest one.

        Where all messages in a row are, that one is wrong: what came with it is forgotten. If it
        was used already, the clock was set back: raises InputError.
        """
        behind = self._newest_any - stamp
        if self._first_any is None or behind <= AHEAD:
            self._num_behind = 0
            return
        self._num_behind += 1
        if self._num_behind < PERSISTENT:
            return
        self._num_behind = 0
        if self._last is not None and self._last - stamp > AHEAD:
            raise InputError(f'the clock of {stream} jumped back by {behind / SECOND:.1f} s')
        self._forget_after(stamp + AHEAD)

    def _forget_after(self, stamp: int) -> None:
        for stream in [s for s, newest in self._newest.items() if newest > stamp]:
            error = f'{stream} at {self._newest.pop(stream)} ns is far ahead of all other stamps'
            self.inputs.count(stream, 'future', error)
        self._newest_of = {k: s for k, s in self._newest_of.items() if s <= stamp}
        self._waiting = [w for w in self._waiting if w[0] <= stamp]
        self.buffer.forget_after(stamp)
        self._newest_any = max(self._newest.values(), default=stamp)

    def _wait(self, stamp: int, stream: str, item: Scan | Detections) -> None:
        self._waiting.append((stamp, stream, item, self._measured_later(stream, item)))
        self._waiting.sort(key=lambda w: (w[0], w[1]))

    def _release(self, ready: Callable[[int, int], bool] | None = None) -> list[Observation]:
        if not self._waiting and not self._parked:
            return []
        out = self._unpark(CONFIRM if ready is None else 1)
        while self._waiting:
            stamp = self._waiting[0][0]
            # one scan and one set of detections; a second lidar's scan is the next observation
            group: list[Waiting] = []
            for w in self._waiting:
                if w[0] - stamp <= PAIRING and w[1] not in [g[1] for g in group]:
                    group.append(w)
            end = max(self._end(w[2], w[3]) for w in group)
            if ready is None and not self._is_ready(stamp, end, group):
                break
            self._waiting = [w for w in self._waiting if not any(w is g for g in group)]
            if self._last is not None:
                stamp = max(stamp, self._last + 1)  # two lidars at the very same instant
            out.append(self._observe(stamp, group))
        return out

    @staticmethod
    def _end(item: Scan | Detections, later: int) -> int:
        sweep = sweep_time(item) if isinstance(item, Scan) else 0.0
        return item.stamp + max(later, 0) + int(sweep * SECOND)

    def _is_ready(self, stamp: int, end: int, group: list[Waiting]) -> bool:
        waited = self._newest_any - end
        if waited > self._timeout:
            self.inputs.count(group[0][1], 'waited_out')
            return True
        if self._node.use_odom:
            newest = self.buffer.newest
            if newest is None:
                # without any odometry for a second, there is none to wait for
                if self._first_any is not None and self._newest_any - self._first_any < SECOND:
                    return False
            elif newest < end:
                return False
        if len(self._lidars) > 1 and self._is_lidar_due(stamp, group):
            return False
        fresh = self._first_any is None or stamp - self._first_any < SECOND
        if len(group) == 1 and (fresh or stamp - self._paired < SECOND):
            other = 'reflectors' if group[0][1] == 'scan' else 'scan'
            # the streams come in pairs: the other half is on its way, unless it was left out
            if self._newest.get(other, 0) <= stamp and waited <= self._timeout // 2:
                return False
        return True

    def _is_lidar_due(self, stamp: int, group: list[Waiting]) -> bool:
        """Whether another lidar, by its period, still has a scan to send before this one."""
        here = {w[2].frame_id for w in group if w[1] == 'scan'}
        return any(
            newest + period <= stamp + PAIRING and stamp - newest < SECOND
            for frame_id, (newest, period) in self._lidars.items()
            if period > 0 and frame_id not in here
        )

    def _observe(self, stamp: int, group: list[Waiting]) -> Observation:
        scan: Scan | None = None
        points = origin = detections = T = delta = None
        odom_pose = self.buffer.pose_at(stamp)
        stale = self._stale(group, odom_pose)
        for _, stream, item, later in group:
            if item.frame_id in stale:
                self.inputs.count(stream, 'repeated')
                continue
            self.inputs.count(stream, 'used')
            # from the base at the stamp to the base when it was measured
            moved = self._moved(item.stamp, item.stamp + later)
            at = se2.compose(moved, self._sensor_pose(item.frame_id))
            if not isinstance(item, Scan):
                detections = self._in_base(item, at)
            elif self._node.use_scan:
                scan, T = item, at
                began = item.stamp + later
                swept = self.buffer.motion(began, began + int(sweep_time(item) * SECOND)).delta
                delta = se2.compose(se2.compose(moved, swept), se2.inverse(moved))
        if scan is not None and T is not None and delta is not None:
            points = project(scan, T, delta, self._p.submap.max_laser_range)
            origin = T[:2].copy()
            if not len(points):
                self.inputs.count('scan', 'no_returns')
        if len(group) == 2:
            self._paired = stamp
        motion = STILL
        stamp_sigma, white = self._errors_of(group)
        if self._last is not None:
            motion = compose_motion(self._carried, self._motion(self._last, stamp))
            motion = widened(motion, stamp - self._last, math.hypot(white, self._white))
        self._last, self._carried, self._white = stamp, STILL, white
        return Observation(
            stamp,
            motion,
            points,
            origin,
            detections,
            scan,
            odom_pose,
            T,
            delta,
            stamp_sigma,
        )

    def _stale(self, group: list[Waiting], odometry: Array | None) -> set[str]:
        """Frames of lidars that sent an old scan; what was detected in it is as old."""
        # one that is there for its stamp alone may be empty, or made up
        scans = [s for _, _, s, _ in group if isinstance(s, Scan) and self._node.use_scan]
        return {scan.frame_id for scan in scans if self._repeats.is_stale(scan, odometry)}

    def _errors_of(self, group: list[Waiting]) -> tuple[float, float]:
        """Errors [s] of when it was measured, against odometry, where stamps jitter.

        All of it, and what is of these stamps alone.
        """
        sources = [('odom', ''), *(self._clock_of(item) for _, _, item, _ in group[:1])]
        clocks = [c for c in map(self._clocks.get, sources) if c is not None]
        return (
            math.hypot(*(c.sigma for c in clocks)) / SECOND,
            math.hypot(*(c.white for c in clocks)) / SECOND,
        )

    def _carry(self, now: int) -> None:
        """Sum up the motion of a long time without observations before the buffer forgets it."""
        if self._last is None or self._waiting or now - self._last < 2 * CARRY:
            return
        until = now - CARRY
        self._carried = compose_motion(self._carried, self._motion(self._last, until))
        self._last = until

    def _motion(self, last: int, stamp: int) -> Motion:
        """Motion since the last observation; what that one assumed, measurements have mended."""
        newest = self.buffer.newest
        if newest is not None and newest < stamp:
            return self.buffer.extrapolate(last, stamp)
        return self.buffer.motion(last, stamp)

    def _moved(self, start: int, end: int) -> Array:
        """Motion (3,) of base from one stamp to another, or back."""
        if end >= start:
            return self.buffer.motion(start, end).delta
        return se2.inverse(self.buffer.motion(end, start).delta)

    def _in_base(self, d: Detections, T: Array) -> Detections:
        """Detections within range of a sensor at ``T`` (3,), moved to the base frame."""
        moved, bounded = placed(d, self._node.base_frame, T, self._p.reflector.max_range)
        if len(moved) < len(d):
            self.inputs.count('reflectors', 'points_out_of_range')
        if bounded:
            self.inputs.count('reflectors', 'sigma_bounded')
        return moved


def widened(motion: Motion, lasted: int, sigma: float) -> Motion:
    """The motion of ``lasted`` [ns] between measurements, whose time is wrong by ``sigma`` [s]."""
    if sigma == 0.0 or not motion.known:
        return motion
    gone = motion.delta / (lasted / SECOND) * sigma
    return dataclasses.replace(motion, cov=motion.cov + np.outer(gone, gone))
