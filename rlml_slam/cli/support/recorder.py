# SPDX-License-Identifier: Apache-2.0
"""A node that listens to a live system and makes a Run of what it hears."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from rlml_slam.cli.support.heard_map import KINDS, HeardMap
from rlml_slam.cli.support.live_bag import LiveBag
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.params import Parameters
from rlml_slam.planning.audit.sightings import SightingLog
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.frame_messages import read_points, read_record
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_associated, read_reflector_map
from rlml_slam.ros.codecs.update_message import UpdateSummary, read_update
from rlml_slam.ros.message_guard import LARGE, Listener, guard_of, listen_to_bytes
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.ros.systems.simulator_messages import TRUE_REFLECTORS
from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Frame, Health, Level, Reflectors, Status

SCAN = ('scan', 'sensor_msgs/msg/LaserScan')
TRUTH = 'ground_truth'
DEEP = QoSProfile(depth=1000)  # of the small messages, none may be lost
SENSOR = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
PATIENCE = 15.0  # [s] in which a busy machine may catch up with what was sent
SETTLE = 0.5  # [s] in which two nodes that are there find each other
NO_REFLECTORS = Reflectors(
    np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)),
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0),
)  # fmt: skip


class HeardSightings:
    """Frames and their detections, which come in either order, joined in a log for an audit."""

    def __init__(self, log: SightingLog) -> None:
        self._log = log
        self._frames: dict[int, Frame] = {}
        self._detections: dict[int, Detections] = {}

    def add_frame(self, frame: Frame) -> None:
        """A frame, which has no detections."""
        self._frames[frame.stamp] = frame
        self._join(frame.stamp)

    def add_detections(self, detections: Detections) -> None:
        """The detections of one frame."""
        self._detections[detections.stamp] = detections
        self._join(detections.stamp)

    def _join(self, stamp: int) -> None:
        if stamp in self._frames and stamp in self._detections:
            frame = self._frames[stamp]
            seen = replace(frame.observation, detections=self._detections[stamp])
            self._log.add(replace(frame, observation=seen))
            for waiting in (self._frames, self._detections):
                for old in [t for t in waiting if t <= stamp]:
                    del waiting[old]


class Recorder(Node):
    """Collects poses, truth, products and diagnostics; every callback may be called directly.

    ``sensor`` is the (topic, type) whose every message asks for a pose.
    """

    def __init__(self, sensor: tuple[str, str] = SCAN, **options: Any) -> None:
        super().__init__('recorder', **options)
        self._sensor = sensor
        self.bag: LiveBag | None = None
        self.frames = FrameLog()
        self.true: dict[int, Array] = {}
        self.latency_ms: list[float] = []
        self.figures: dict[str, dict[str, str]] = {}
        self.sensed = 0
        self.distance = 0.0
        self._sensor_heard: dict[int, float] = {}
        self._healths: dict[int, Health] = {}
        self._sightings = HeardSightings(self.frames.sightings)
        self._answers: dict[int, tuple[Level, float]] = {}
        self._seen: dict[int, tuple[int, int]] = {}
        self._updates: list[UpdateSummary] = []
        self._began: float | None = None
        self._heard = 0.0
        self.map = HeardMap()
        self._reflectors = NO_REFLECTORS
        self._true_reflectors: Detections | None = None
        self._last_true: Array | None = None
        self._hears_sensor = False
        self._settled = time.monotonic() + SETTLE
        listened: tuple[tuple[Any, str, Callable[[Any], None], QoSProfile], ...] = (
            (PoseWithCovarianceStamped, 'pose', self.on_pose, DEEP),
            (PointCloud2, 'rlml/frames', self.on_frame, DEEP),
            (PointCloud2, 'reflectors/associated', self.on_associated, DEEP),
            (PointCloud2, 'updates', self.on_update, DEEP),
            (Odometry, TRUTH, self.on_truth, DEEP),
            (PointCloud2, TRUE_REFLECTORS, self.on_true_reflectors, LATCHED),
            (PointCloud2, 'reflector_map_points', self.on_reflectors, LATCHED),
            (DiagnosticArray, '/diagnostics', self.on_diagnostics, DEEP),
        )
        self._listeners = [Listener(self, *given, LARGE) for given in listened]
        self._guard = guard_of(self)
        listen_to_bytes(self, PointCloud2, 'deskewed_points', self.on_points, DEEP)
        for topic, kind in KINDS.items():
            listen_to_bytes(self, kind, topic, partial(self.map.take, topic), LATCHED)

    def is_ready(self) -> bool:
        """Whether front end and back end are there; from then on the sensor is listened to.

        Its source waits for this listener, so that nobody misses the beginning.
        """
        if self._hears_sensor:
            return True
        now = time.monotonic()
        if not (self.count_publishers('pose') and self.count_publishers('graph')):
            self._settled = now + SETTLE
        if now < self._settled:
            return False
        if self.bag is not None:
            self.bag.listen(self)
        # bytes: the stamp is all that is wanted of a scan
        topic, kind = self._sensor
        listen_to_bytes(self, rclpy_class(kind), topic, self.on_sensor, SENSOR)
        self._hears_sensor = True
        return True

    def on_sensor(self, data: bytes) -> None:
        """One serialized message that begins with a header: note when it came."""
        self.sensed += 1
        if self.bag is not None:
            self.bag.take(data)
        self._sensor_heard[decode.serialized_stamp(data)] = time.monotonic()

    def on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        """The front end's answer to a scan."""
        now = time.monotonic()
        pose = decode.pose_estimate(msg)
        self._began = now if self._began is None else self._began
        self._heard = now
        self.frames.add_pose(pose.stamp, pose.pose, pose.cov)
        heard = self._sensor_heard.pop(pose.stamp, None)
        if heard is not None:
            self.latency_ms.append((now - heard) * 1e3)

    def on_frame(self, msg: PointCloud2) -> None:
        """What the front end says of one pose: its health and its cost."""
        frame = read_record(msg).of.frame
        self._answers[frame.stamp] = (frame.health.level, frame.wall_ms)
        self._sightings.add_frame(frame)

    def on_points(self, data: bytes) -> None:
        """The end points of one scan, serialized: few of them are looked into."""
        stamp = decode.serialized_stamp(data)
        if stamp and self.frames.scans.is_due():
            points = read_points(deserialize_message(data, PointCloud2))
            self.frames.scans.add(stamp, points)
        else:
            self.frames.scans.skip()

    def on_associated(self, msg: PointCloud2) -> None:
        """The detections of one pose, and how many were used."""
        associated = read_associated(msg)
        used = int(np.sum(associated.statuses == Status.USED))
        self._seen[associated.detections.stamp] = (len(associated.statuses), used)
        self._sightings.add_detections(associated.detections)

    def on_update(self, msg: PointCloud2) -> None:
        """What one keyframe did, and its cost."""
        self._updates.append(read_update(msg))

    def on_truth(self, msg: Odometry) -> None:
        """Where the robot really is."""
        stamp, pose = decode.stamp(msg, TRUTH), decode.planar_pose(msg.pose.pose, TRUTH)
        if self._last_true is not None:
            self.distance += float(np.hypot(*(pose - self._last_true)[:2]))
        self._last_true = pose
        self.true[stamp] = pose

    def on_true_reflectors(self, msg: PointCloud2) -> None:
        """Where the reflectors really are."""
        self._true_reflectors = decode.detections(msg, Parameters().reflector, TRUE_REFLECTORS)

    def on_reflectors(self, msg: PointCloud2) -> None:
        """The newest reflector map."""
        self._reflectors = read_reflector_map(msg)

    def on_diagnostics(self, msg: DiagnosticArray) -> None:
        """Health of the front end, and the figures of both nodes."""
        stamp = decode.known_stamp(msg)
        for status in msg.status:
            name = status.name.rsplit('/')[-1]
            self.figures[name] = {v.key: v.value for v in status.values}
            if name == 'front_end':
                level = status.level[0] if isinstance(status.level, bytes) else status.level
                reasons = tuple(status.message.split('; ')) if level else ()
                self._healths[stamp] = Health(Level(min(int(level), 2)), reasons)

    def sent(self) -> int:
        """Messages of the sensor that its source says it sent; else those that came here."""
        key = f'{self._sensor[0]} published'
        counted = [int(f[key]) for f in self.figures.values() if f.get(key, '').isdecimal()]
        return counted[0] if counted else self.sensed

    def error(self) -> float | None:
        """Position error [m] of the newest pose whose truth is known."""
        for stamp, pose in zip(
            self.frames.stamps[:-10:-1], self.frames.poses[:-10:-1], strict=True
        ):
            if stamp in self.true:
                return float(np.hypot(*(pose - self.true[stamp])[:2]))
        return None

    def elapsed(self) -> float:
        """Seconds of message time from the first pose to the newest."""
        stamps = self.frames.stamps
        return (stamps[-1] - stamps[0]) * 1e-9 if stamps else 0.0

    def silence(self, now: float) -> float:
        """Seconds since the last pose, 0 before the first."""
        return now - self._heard if self._began is not None else 0.0

    def has_caught_up(self, since: float) -> bool:
        """Whether all scans came and the newest has its pose, in map and diagnostics as well.

        ``since`` is when the source ended; after PATIENCE the answer is yes in any case.
        """
        if time.monotonic() - since > PATIENCE:
            return True
        newest = max(self._sensor_heard, default=0)
        path = self.map.newest.get('trajectory')
        mapped = decode.serialized_stamp(path) if path is not None else 0
        answered = self.frames.stamps[-1] if self.frames.stamps else 0
        reported = max(self._healths, default=0)
        return self.sensed >= self.sent() and min(mapped, reported) >= answered >= newest

    def note(self) -> str:
        """One line for the progress."""
        error = self.error()
        parts = [
            f'{len(self.frames.stamps)} poses' if error is None else f'error {100 * error:.1f} cm',
            f'{len(self._reflectors)} reflectors',
            f'{len(self._updates)} keyframes',
            f'{sum(u.accepted for u in self._updates)} closures',
        ]
        return ', '.join(parts)

    def run(self, name: str) -> Run:
        """Everything that was heard."""
        self.map.read(self._guard)
        stamps, log = np.array(sorted(self.true), dtype=np.int64), self._log()
        truth = None
        if len(stamps):
            path = Trajectory(stamps, np.array([self.true[t] for t in sorted(self.true)]))
            known = self._true_reflectors
            truth = (
                Truth(path, True) if known is None else Truth(path, True, known.ids, known.points)
            ).in_map_of(log)
        wall = 0.0 if self._began is None else self._heard - self._began
        return Run(
            name, log, self.trajectory(), self._reflectors, self.map.grid,
            self.map.keyframes, self.map.closures, sum(u.rejected for u in self._updates),
            np.array([u.wall_ms for u in self._updates]),
            inputs=self.inputs(), truth=truth, wall_s=wall,
        )  # fmt: skip

    def _log(self) -> FrameLog:
        """The poses as published, each with its own health, detections and cost."""
        log, live = FrameLog(sightings=self.frames.sightings), self.frames
        for stamp, pose, cov in zip(live.stamps, live.poses, live.covs, strict=True):
            level, wall_ms = self._answers.get(stamp, (Level.OK, None))
            log.add_pose(stamp, pose, cov, Health(level, self._reasons(stamp, level)))
            if wall_ms is not None:
                log.wall_ms.append(wall_ms)
            seen, used = self._seen.get(stamp, (0, 0))
            log.seen.append(seen)
            log.used.append(used)
        log.scans = live.scans
        return log

    def _reasons(self, stamp: int, level: Level) -> tuple[str, ...]:
        """Reasons of the diagnostics nearest in time with the same level."""
        if level is Level.OK:
            return ()
        near = min(
            (t for t, h in self._healths.items() if h.level is level),
            key=lambda t: abs(t - stamp), default=None,
        )  # fmt: skip
        return () if near is None else self._healths[near].reasons

    def trajectory(self) -> Trajectory:
        """The newest trajectory, and for the scans before and after it the live poses."""
        live, path = self.frames.trajectory(), self.map.path
        if not len(path):
            return live
        head, tail = live.stamps < path.stamps[0], live.stamps > path.stamps[-1]
        return Trajectory(
            np.concatenate([live.stamps[head], path.stamps, live.stamps[tail]]),
            np.concatenate([live.poses[head], path.poses, live.poses[tail]]),
        )

    def inputs(self, node: str = 'front_end') -> dict[str, dict[str, int]]:
        """What became of a node's inputs, from its diagnostics."""
        out: dict[str, dict[str, int]] = {}
        for key, value in self.figures.get(node, {}).items():
            stream, _, what = key.partition(' ')
            if what and value.isdecimal() and stream in ('scan', 'odom', 'imu', 'reflectors'):
                fate = out.setdefault(stream, {'used': 0, 'late': 0, 'invalid': 0})
                fate[what] = int(value)
        return out
