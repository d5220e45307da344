# SPDX-License-Identifier: Apache-2.0
"""Synchronization: inputs in any order become observations in the order of their stamps.

A scan waits for the odometry that covers its last ray, for the detections of the same stamp, and
for the scans of other lidars that are due before it (:mod:`waiting_queue`). All decisions depend
on stamps and order of arrival, never on a clock, so that a replay repeats them exactly. Jitter of
the stamps is removed (:mod:`stamp_jitter`); stamps that cannot be right are rejected
(:mod:`stamp_check`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from rlml_slam.motion import SECOND, MotionBuffer
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.no_return import NoReturnRanges
from rlml_slam.sensing.reflectors.scan_reflectors import ScanReflectors
from rlml_slam.sensing.synchronization.gyro_check import GyroCheck
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.observation_assembly import ObservationAssembly
from rlml_slam.sensing.synchronization.odometry_delay import OdometryDelay
from rlml_slam.sensing.synchronization.odometry_sources import TF, TOPIC, OdometrySources
from rlml_slam.sensing.synchronization.sensor_kinds import SensorKinds
from rlml_slam.sensing.synchronization.stamp_check import CONFIRM, StampCheck
from rlml_slam.sensing.synchronization.stamp_jitter import StampJitter
from rlml_slam.sensing.synchronization.sweep_check import SweepCheck
from rlml_slam.sensing.synchronization.waiting_queue import WaitingQueue
from rlml_slam.types import Detections, Frame, Imu, Observation, Odometry, Scan, Status

MEASURED = ('scan', 'reflectors')  # streams that give observations
LARGEST_VIEW = 2.2 * math.pi  # [rad] some drivers repeat beams at the end of a turn
FINEST = 1e-5  # [rad] between beams: the finest lidars have twenty times that
FARTHEST = 300.0  # [m] that any 2D laser measures
WAITED = 0.75  # share of ``odom_timeout`` by which odometry is corrected at most


class Synchronizer:
    """Collects the inputs of one robot; each ``add_…`` returns the observations that are ready.

    An invalid input is counted in ``inputs`` and not used. InputError if all stamps stay behind
    (a looped bag, a clock that was set back): the caller has to start a new synchronizer.
    """

    def __init__(self, params: Parameters) -> None:
        self._node = params.node
        self.inputs = InputCounts()
        self._stamps = StampCheck(self.inputs)
        self._jitter = StampJitter(self._node.filter_stamps)
        self._queue = WaitingQueue(params, self._stamps, self.inputs)
        self._fastest_turn = params.motion.max_turn_rate
        self.odometry = OdometrySources(self._node.odom_source, self._node.tf_buffer_duration)
        self.delay = OdometryDelay()
        self.gyro = GyroCheck()
        # scans would wait for later odometry in vain
        self._longest_delay = int(WAITED * self._node.odom_timeout * SECOND)
        self._assembly = ObservationAssembly(params, self.inputs, self.odometry.transforms)
        self._no_returns = NoReturnRanges()
        self._sweeps = SweepCheck(self.inputs)
        self._kinds = {stream: SensorKinds() for stream in MEASURED}
        self._add: dict[str, Callable[[Any], list[Observation]]] = {
            TOPIC: self.add_odometry,
            TF: self.add_transform,
            'imu': self.add_imu,
            'scan': self.add_scan,
            'reflectors': self.add_detections,
        }

    @property
    def buffer(self) -> MotionBuffer:
        """Odometry and IMU samples."""
        return self._assembly.buffer

    @property
    def reflectors(self) -> ScanReflectors:
        """What is detected in the scans themselves."""
        return self._assembly.reflectors

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Set the pose (3,) of a sensor; without it the parameter ``laser_pose`` is used."""
        self._assembly.set_sensor_pose(frame_id, T_base_sensor)

    def expect(self, stamps: Iterable[int], now: float) -> None:
        """Messages with these stamps [ns] arrived together, at ``now`` [s] of a steady clock."""
        self._stamps.expect(stamps, now)

    def add_odometry(self, sample: Odometry) -> list[Observation]:
        """Add one sample of the odometry topic."""
        return self._add_pose(TOPIC, sample) if self._node.use_odom else []

    def add_transform(self, sample: Odometry) -> list[Observation]:
        """Add the pose of base in odom as it is on /tf."""
        return self._add_pose(TF, sample)

    def _add_pose(self, source: str, sample: Odometry) -> list[Observation]:
        if self._stamps.holds(source, sample):
            return self._release()
        stamp = self._jitter.filtered(source, sample.stamp)
        # others compute with the stamps that are on /tf: only the motion has the filtered one
        if source == TOPIC and stamp != sample.stamp:
            sample = Odometry(stamp, sample.pose)
        valid = np.shape(sample.pose) == (3,) and all(map(math.isfinite, sample.pose))
        if not self._accept(source, sample.stamp, valid, 'pose is not finite'):
            return self._release()
        last, used = self.odometry.source, self.odometry.use(source, sample)
        if last and last != self.odometry.source:  # another driver, another delay
            self.delay = OdometryDelay()
            self.buffer.set_odometry_delay(0)
        if used is None or not self._node.use_odom:
            self.inputs.count(TOPIC, 'compared')
            return self._release()
        sample = used if stamp == used.stamp else Odometry(stamp, used.pose)
        if self.buffer.add_odometry(sample):
            self.inputs.count(TOPIC, 'used')
            self.delay.add_odometry(stamp, sample.pose[2])
            self.gyro.add_odometry(stamp, sample.pose[2])
            if self.gyro.fault:
                self.buffer.forget_imu_after(0)
        else:
            far = 'jumps: no robot moves as far since the one before; is it in metres and radians?'
            self.inputs.count(TOPIC, 'jump', f'odometry at {stamp} ns {far}')
            self.gyro.restart()
        if not len(self._queue):
            self._assembly.carry(stamp)
        return self._release()

    def add_imu(self, sample: Imu) -> list[Observation]:
        """Add one sample of the IMU."""
        if not self._node.use_imu:
            return []
        if self._stamps.holds('imu', sample):
            return self._release()
        stamp = self._jitter.filtered('imu', sample.stamp)
        sample = sample if stamp == sample.stamp else Imu(stamp, sample.yaw_rate)
        if math.isfinite(sample.yaw_rate):
            self.gyro.add_imu(sample)
        possible = abs(sample.yaw_rate) <= self._fastest_turn
        why = f'no robot turns at {sample.yaw_rate:g} rad/s (is it in degrees per second?)'
        if self._accept('imu', stamp, possible, why):
            if self.gyro.fault:
                self.inputs.count('imu', 'contradicts', self.gyro.error)
            else:
                self.buffer.add_imu(sample)
                self.inputs.count('imu', 'used')
        return self._release()

    def add_scan(self, scan: Scan) -> list[Observation]:
        """Add one sweep; without ``use_scan`` only its stamp is used."""
        if self._stamps.holds('scan', scan):
            return self._release()
        error = invalid_geometry(scan)
        if error:
            self.inputs.count('scan', 'invalid', f'scan at {scan.stamp} ns: {error}')
        elif self._is_of_sensor(
            'scan', scan, scan.angle_min, scan.angle_increment, scan.time_increment
        ) and self._accept('scan', scan.stamp, source=scan.frame_id):
            scan = self._sweeps.possible(scan)
            self._queue.note_lidar(scan)
            self._wait('scan', self._no_returns.left_out(scan))
        return self._release()

    def add_detections(self, detections: Detections) -> list[Observation]:
        """Add the reflector detections of one instant."""
        if not self._node.use_reflectors:
            return []
        if self._stamps.holds('reflectors', detections):
            return self._release()
        d = detections
        finite = np.isfinite(d.points).all() and np.isfinite(d.cov).all()
        if self._is_of_sensor('reflectors', d) and self._accept(
            'reflectors', d.stamp, bool(finite), 'a point or covariance is not finite', d.frame_id
        ):
            self._assembly.leave_detection()
            self._wait('reflectors', d)
        return self._release()

    def follow(self, frame: Frame) -> None:
        """Correct the stamps of odometry by what the pose of an observation says of its delay.

        A pose that neither scan nor reflectors corrected is that of the odometry itself.
        """
        is_measured = frame.scan_used or (frame.statuses == Status.USED).any()
        if is_measured:
            self.gyro.add_pose(frame.T_local_base[2])
        if not self._node.estimate_odometry_delay or not is_measured:
            return
        before = self.delay.now
        self.delay.add_pose(frame.stamp, frame.T_local_base[2])
        if self.delay.now != before:
            self.buffer.set_odometry_delay(min(self.delay.now, self._longest_delay))

    def flush(self) -> list[Observation]:
        """Observations of all that still waits, at the end of the data."""
        return self._release(flush=True)

    def _is_of_sensor(self, stream: str, item: Scan | Detections, *values: float) -> bool:
        """Whether it is of a known sensor, as its ``values`` show; counts it as invalid if not."""
        base, error = self._node.base_frame, f'{stream} in frame {item.frame_id[:100]!r}'
        if not self._assembly.has_frame(stream, item.frame_id):
            error += f', whose pose in {base} is unknown: publish it on /tf_static'
        elif self._kinds[stream].is_foreign(item.frame_id, *values):
            error += ', of another sensor than almost all others'
            if values:
                error += f' (angle_min, angle_increment, time_increment: {values})'
        else:
            return True
        self.inputs.count(stream, 'invalid', error)
        return False

    def _accept(
        self, stream: str, stamp: int, valid: bool = True, why: str = '', source: str = ''
    ) -> bool:
        """Reject and count what is invalid, duplicate, or older than what was used already."""
        if not valid or stamp <= 0:
            error = f'{stream} at {stamp} ns: {why or "stamp is not positive"}'
            self.inputs.count(stream, 'invalid', error)
            return False
        if self._stamps.is_duplicate(stream, stamp, source):
            return False
        last = self._assembly.last
        wrong_after = self._stamps.wrong_after(stream, stamp, last)
        if wrong_after is not None:
            self._stamps.forget_after(wrong_after)
            self._queue.drop_after(wrong_after)
            self._jitter.restart()
            self.buffer.forget_after(wrong_after)
            self.odometry.forget_after(wrong_after)
        early_after = self._stamps.early_after(stream, stamp, source)
        if early_after is not None:
            self._forget_early(stream, early_after, source)
        is_measured = stream in MEASURED
        limit = last if is_measured else self._stamps.newest_of(stream)
        if self._stamps.accept(stream, stamp, limit, source):
            return True
        if is_measured and stamp == last:
            self._queue.note_pair(stamp)  # the other half of the next one will be waited for
        return False

    def _forget_early(self, stream: str, stamp: int, source: str) -> None:
        """Drop what a source sent with stamps ahead of those that followed."""
        self._stamps.forget_early(stream, stamp, source)
        clock = source if self._queue.has_several_lidars else ''
        self._jitter.restart(('instant' if stream in MEASURED else stream, clock))
        if stream in MEASURED:
            self._queue.drop_after(stamp, stream, source)
        elif stream == 'imu':
            self.buffer.forget_imu_after(stamp)
        else:
            self.odometry.forget_early(stream, stamp)
            if stream == self.odometry.source:
                self.buffer.forget_odometry_after(stamp)

    def _wait(self, stream: str, item: Scan | Detections) -> None:
        delay = self._jitter.delay(item.stamp, self._clock_of(item))
        self._queue.add(stream, item, delay)

    def _clock_of(self, item: Scan | Detections) -> str:
        """Source of the clock of scans and detections: one per lidar."""
        return item.frame_id if self._queue.has_several_lidars else ''

    def _release(self, flush: bool = False) -> list[Observation]:
        """All observations that are ready."""
        if not len(self._queue) and not self._stamps.has_held:
            return []
        out = []
        for stream, message in self._stamps.release_held(1 if flush else CONFIRM):
            out += self._add[stream](message)
        newest = self.buffer.newest
        if newest is not None:  # others look up the odometry that has the stamp of the scan
            newest += min(self.delay.now, 0)
        while group := self._queue.pop(self.odometry.newest(newest), flush):
            stamp = group[0].stamp
            if self._assembly.is_in_gap(stamp):
                self.inputs.count(group[0].stream, 'in_gap')
                continue
            if self._assembly.last is not None:
                stamp = max(stamp, self._assembly.last + 1)  # two lidars at the same instant
            clock = self._clock_of(group[0].item)
            errors = self._jitter.errors(clock, self.odometry.source)
            out.append(self._assembly.assemble(stamp, group, errors))
            if len(group) == 2:
                self._queue.note_pair(stamp)
        return out


def invalid_geometry(scan: Scan) -> str:
    """Why a scan cannot be used, empty if it can."""
    n = len(scan.ranges)
    if n == 0:
        return 'it is empty'
    for name in ('angle_min', 'angle_increment', 'time_increment', 'range_min', 'range_max'):
        value = getattr(scan, name)
        if not math.isfinite(value) or (name == 'angle_increment' and value == 0.0):
            return f'{name} is {value:g}'
    if scan.range_min < 0.0:
        return f'range_min is {scan.range_min:g} m'
    view = abs(scan.angle_increment) * (n - 1)
    if view > LARGEST_VIEW or (n > 1 and abs(scan.angle_increment) < FINEST):
        return f'angle_increment {scan.angle_increment:g} rad times {n} beams is no field of view'
    if abs(scan.angle_min) > LARGEST_VIEW:
        return f'angle_min is {scan.angle_min:g} rad, more than a turn'
    if scan.range_max > FARTHEST:
        seen = scan.ranges[(scan.ranges > scan.range_min) & (scan.ranges < scan.range_max)]
        if len(seen) and (middle := float(np.median(seen))) > FARTHEST:
            return f'half of its ranges are {middle:.0f} m or more: are they in millimetres?'
    return ''
