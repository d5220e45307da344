# SPDX-License-Identifier: Apache-2.0
"""Assembly of an observation from scan, detections and motion, at one stamp."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import MAX_VARIANCE, SECOND, STILL, MotionBuffer, compose_motion
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import num_arcs, project, sweep_time
from rlml_slam.sensing.detection_frames import placed
from rlml_slam.sensing.reflectors.scan_reflectors import ScanReflectors
from rlml_slam.sensing.repeated_scans import RepeatedScans
from rlml_slam.sensing.robot_parts import RobotParts
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.odometry_sources import PoseHistory
from rlml_slam.sensing.synchronization.waiting_queue import Waiting
from rlml_slam.types import Detections, Motion, Observation, Scan

# [ns] Motion older than this is summed up while there are no observations: the buffer drops it,
# and an observation that is later than this is late.
MAX_LATE = 5 * SECOND
MAY_MOVE = np.array([0.5, 0.5, 0.5])  # [m/s, m/s, rad/s] of a robot without odometry, 1 sigma


class ObservationAssembly:
    """Places scans and detections in the base frame, and computes the motion between stamps.

    ``last`` [ns] is the stamp up to which motion is used, None before the first observation.
    """

    def __init__(
        self, params: Parameters, inputs: InputCounts, transforms: PoseHistory | None = None
    ) -> None:
        self._p = params
        self._node = params.node
        self._inputs = inputs
        self.buffer = MotionBuffer(params.motion, self._node.tf_buffer_duration)
        self._transforms = transforms or PoseHistory(self._node.tf_buffer_duration)
        self._sensor_poses: dict[str, Array] = {self._node.base_frame: np.zeros(3)}
        self._default_frame: dict[str, str] = {}
        self._repeats, self._parts = RepeatedScans(), RobotParts()
        self.reflectors = ScanReflectors(params.detector, self._node.detect_reflectors)
        self._detects = self._node.use_reflectors
        self.last: int | None = None
        self._carried = STILL  # motion up to ``last`` since the last observation
        self._white = 0.0  # [s] white part of the error of the last stamp

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Set the pose (3,) of a sensor; without it the parameter ``laser_pose`` is used."""
        self._sensor_poses[frame_id] = np.asarray(T_base_sensor, dtype=np.float64)

    def leave_detection(self) -> None:
        """Somebody else detects the reflectors."""
        self._detects = self._detects and self._node.detect_reflectors == 'on'

    def has_frame(self, stream: str, frame_id: str) -> bool:
        """Whether the pose of a sensor is known; the first unknown frame gets ``laser_pose``."""
        if frame_id in self._sensor_poses:
            return True
        return self._default_frame.setdefault(stream, frame_id) == frame_id

    def assemble(
        self, stamp: int, group: list[Waiting], errors: tuple[float, float]
    ) -> Observation:
        """Observation of the scan and detections of an instant.

        ``errors`` [s] are the error of the stamp against odometry, and its white part.
        """
        odom_pose = self._odom_pose(stamp)
        stale = self._stale_frames(group, odom_pose)
        scan: Scan | None = None
        points = origin = detections = T = sweep = sweep_cov = None
        for w in group:
            if w.item.frame_id in stale:
                self._inputs.count(w.stream, 'repeated')
                continue
            self._inputs.count(w.stream, 'used')
            # motion of base from the stamp to the time of the measurement
            moved = self._moved(w.item.stamp, w.item.stamp + w.delay)
            T_base_sensor = se2.compose(moved, self._sensor_pose(w.item.frame_id))
            if not isinstance(w.item, Scan):
                detections = self._in_base(w.item, T_base_sensor)
            elif self._node.use_scan:
                scan, T = w.item, T_base_sensor
                if self._node.leave_out_robot_parts:
                    scan = self._parts.left_out(w.item, odom_pose, float(T[2]))
                if scan is not w.item:
                    self._inputs.count('scan', 'robot_parts')
                sweep, noise, known = self._sweep(w.item, w.delay, moved)
                sweep_cov = noise if known else None
                if self._detects and not any(w.stream == 'reflectors' for w in group):
                    seen = self.reflectors.detections(scan, T, sweep, noise, odom_pose)
                    detections = None if seen is None else self._in_base(seen, T)
        if scan is not None and T is not None and sweep is not None:
            points = project(scan, T, sweep, self._p.submap.max_laser_range)
            origin = T[:2].copy()
            if not len(points):
                self._inputs.count('scan', 'no_returns')
        sigma, white = errors
        motion = self._motion_to(stamp, white)
        return Observation(
            stamp, motion, points, origin, detections, scan, odom_pose, T, sweep, sigma, sweep_cov
        )

    def _odom_pose(self, stamp: int) -> Array | None:
        """Pose (3,) of base in odom at a stamp: that of /tf where it is there, else the topic's.

        Where /tf ends before the stamp, the motion since then continues it.
        """
        newest = self._transforms.newest
        if newest is None:
            return self.buffer.pose_at(stamp)
        if stamp <= newest:
            return self._transforms.at(stamp)
        since = self._motion(newest, stamp)
        return se2.compose(self._transforms.last, since.delta) if since.known else None

    def is_in_gap(self, stamp: int) -> bool:
        """Whether all messages were missing until a stamp, and odometry comes only after it.

        The motion until then is unknown. That until the odometry is not, so it has to be whole.
        """
        gap = self.buffer.gap_at(stamp)
        since = min(gap, 0 if self.last is None else stamp - self.last)
        return since > self._p.motion.max_gap * SECOND

    def carry(self, now: int) -> None:
        """Sum up the motion of a long time without observations before the buffer drops it."""
        if self.last is None or now - self.last < 2 * MAX_LATE:
            return
        until = self.buffer.newest_until(now - MAX_LATE)
        if until is None or until <= self.last:
            return  # in a gap: what the odometry tells of it is where it leads to
        self._carried = compose_motion(self._carried, self._motion(self.last, until))
        self.last = until

    def _motion_to(self, stamp: int, white: float) -> Motion:
        """Motion since the last observation, which this one becomes."""
        motion = STILL
        if self.last is not None:
            motion = compose_motion(self._carried, self._motion(self.last, stamp))
            motion = widened(motion, stamp - self.last, math.hypot(white, self._white))
            motion = limited(motion)
        self.last, self._carried, self._white = stamp, STILL, white
        return motion

    def _motion(self, start: int, end: int) -> Motion:
        """Motion between two stamps, extrapolated if there is no odometry yet at the end."""
        newest = self.buffer.newest
        if newest is not None and newest < end:
            return self.buffer.extrapolate(start, end)
        return self.buffer.motion(start, end)

    def _moved(self, start: int, end: int) -> Array:
        """Motion (3,) of base from one stamp to another, also backwards."""
        if end >= start:
            return self.buffer.motion(start, end).delta
        return se2.inverse(self.buffer.motion(end, start).delta)

    def _sweep(self, scan: Scan, delay: int, moved: Array) -> tuple[Array, Array, bool]:
        """Motion (a, 3) of base during a sweep, its covariance, and whether odometry covers it.

        In the base frame at the stamp, by arcs (eq. 70).

        The covariance is that about the first ray, which is at most a scan away from the stamp;
        without odometry that of a robot of which only is known how fast it may be.
        """
        start, lasts = scan.stamp + delay, sweep_time(scan)
        end, arcs = start + int(lasts * SECOND), num_arcs(lasts)
        swept = self.buffer.motion(start, end)
        cuts, path = [start + (end - start) * k // arcs for k in range(arcs)], [np.zeros(3)]
        for since, until in itertools.pairwise(cuts):
            path.append(se2.compose(path[-1], self.buffer.motion(since, until).delta))
        path = [*path[1:], swept.delta]
        cov = swept.cov
        if not swept.known:
            cov = np.diag(np.minimum(np.diag(cov), (MAY_MOVE * lasts) ** 2))
        return se2.compose(se2.compose(moved, path), se2.inverse(moved)), cov, swept.known

    def _sensor_pose(self, frame_id: str) -> Array:
        return self._sensor_poses.get(frame_id, np.array(self._node.laser_pose))

    def _stale_frames(self, group: list[Waiting], odometry: Array | None) -> set[str]:
        """Frames of lidars that sent an old scan again; detections in these are old, too."""
        # without use_scan, only the stamp of a scan is used: it may be empty
        scans = [w.item for w in group if isinstance(w.item, Scan) and self._node.use_scan]
        return {scan.frame_id for scan in scans if self._repeats.is_stale(scan, odometry)}

    def _in_base(self, d: Detections, T_base_sensor: Array) -> Detections:
        """Detections within range of a sensor at a pose (3,), in the base frame."""
        moved, bounded = placed(
            d, self._node.base_frame, T_base_sensor, self._p.reflector.max_range
        )
        if len(moved) < len(d):
            self._inputs.count('reflectors', 'points_out_of_range')
        if bounded:
            self._inputs.count('reflectors', 'sigma_bounded')
        return moved


def widened(motion: Motion, duration: int, sigma: float) -> Motion:
    """The motion of ``duration`` [ns], with the noise of an error ``sigma`` [s] of that time.

    cov + (v sigma) (v sigma)^T with v = delta / duration.
    """
    if sigma == 0.0 or not motion.known:
        return motion
    moved = motion.delta / (duration / SECOND) * sigma
    return dataclasses.replace(motion, cov=motion.cov + np.outer(moved, moved))


def limited(motion: Motion) -> Motion:
    """The motion, no variance of it above MAX_VARIANCE, whatever time its stamps say it took."""
    variances = motion.cov.diagonal()
    if variances.max() <= MAX_VARIANCE:
        return motion
    scale = np.sqrt(MAX_VARIANCE / np.maximum(variances, MAX_VARIANCE))
    return dataclasses.replace(motion, cov=scale[:, None] * motion.cov * scale)
