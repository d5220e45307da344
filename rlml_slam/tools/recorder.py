# SPDX-License-Identifier: Apache-2.0
"""A node that listens to a live system and makes a Run of what it hears."""

from __future__ import annotations

import struct
import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.ros import convert
from rlml_slam.ros.associated import read_reflector_map
from rlml_slam.ros.messages import rclpy_class
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.ros.simulated import TRUE_REFLECTORS
from rlml_slam.se2 import Array
from rlml_slam.tools.record import FrameLog, Run, Truth
from rlml_slam.tools.tum import Trajectory
from rlml_slam.types import Detections, Health, Level, Reflectors

SCAN = ('scan', 'sensor_msgs/msg/LaserScan')
DEEP = QoSProfile(depth=1000)  # of the small messages, none may be lost
SENSOR = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
LAST_MAP = 1_500_000_000  # [ns] of the drive's end that the last published map may lack
PATIENCE = 15.0  # [s] in which a busy machine may catch up with what was sent
SETTLE = 1.0  # [s] in which two nodes that are there find each other
FRAME_TIME = 'wall time of the last frame [ms]'
NO_REFLECTORS = Reflectors(
    np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)),
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0),
)  # fmt: skip


class Recorder(Node):
    """Collects poses, truth, products and diagnostics; every callback may be called directly.

    ``sensor`` is the (topic, type) whose every message asks for a pose.
    """

    def __init__(self, sensor: tuple[str, str] = SCAN, **options: Any) -> None:
        super().__init__('recorder', **options)
        self._sensor = sensor
        self.frames = FrameLog()
        self.true: dict[int, Array] = {}
        self.latency_ms: list[float] = []
        self.figures: dict[str, dict[str, str]] = {}
        self.sensed = 0
        self.distance = 0.0
        self._sensor_heard: dict[int, float] = {}
        self._health = Health()
        self._began: float | None = None
        self._heard = 0.0
        self._path = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))
        self._grid: OccupancyGrid | None = None
        self._reflectors = NO_REFLECTORS
        self._true_reflectors: Detections | None = None
        self._keyframes, self._closures = np.zeros((0, 3)), np.zeros((0, 2, 2))
        self._last_true: Array | None = None
        self._listener: Any = None
        self._settled = time.monotonic() + SETTLE
        listen = self.create_subscription
        listen(PoseWithCovarianceStamped, 'pose', self.on_pose, DEEP)
        listen(Odometry, 'ground_truth', self.on_truth, DEEP)
        listen(PointCloud2, TRUE_REFLECTORS, self.on_true_reflectors, LATCHED)
        listen(OccupancyGridMsg, 'map', self.on_map, LATCHED)
        listen(Path, 'trajectory', self.on_trajectory, LATCHED)
        listen(PointCloud2, 'reflector_map_points', self.on_reflectors, LATCHED)
        listen(MarkerArray, 'graph', self.on_graph, LATCHED)
        listen(DiagnosticArray, '/diagnostics', self.on_diagnostics, DEEP)

    def is_ready(self) -> bool:
        """Whether front end and back end are there; from then on the sensor is listened to.

        Its source waits for this listener, so that nobody misses the beginning.
        """
        if self._listener is not None:
            return True
        now = time.monotonic()
        if not (self.count_publishers('pose') and self.count_publishers('graph')):
            self._settled = now + SETTLE
        if now < self._settled:
            return False
        # bytes: the stamp is all that is wanted of a scan
        topic, kind = self._sensor
        self._listener = self.create_subscription(
            rclpy_class(kind), topic, self.on_sensor, SENSOR, raw=True
        )
        return True

    def on_sensor(self, data: bytes) -> None:
        """One serialized message that begins with a header: note when it came."""
        # CDR: four bytes of encapsulation, then the header's stamp (int32 sec, uint32 nanosec)
        order = '<' if data[1] & 1 else '>'
        sec, nanosec = struct.unpack_from(f'{order}iI', data, 4)
        self.sensed += 1
        self._sensor_heard[sec * 1_000_000_000 + nanosec] = time.monotonic()

    def on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        """The front end's answer to a scan."""
        now = time.monotonic()
        pose = convert.pose_estimate(msg)
        self._began = now if self._began is None else self._began
        self._heard = now
        self.frames.add_pose(pose.stamp, pose.pose, pose.cov, self._health)
        heard = self._sensor_heard.pop(pose.stamp, None)
        if heard is not None:
            self.latency_ms.append((now - heard) * 1e3)

    def on_truth(self, msg: Odometry) -> None:
        """Where the robot really is."""
        pose = convert.planar_pose(msg.pose.pose, 'ground_truth')
        if self._last_true is not None:
            self.distance += float(np.hypot(*(pose - self._last_true)[:2]))
        self._last_true = pose
        self.true[convert.stamp(msg, 'ground_truth')] = pose

    def on_true_reflectors(self, msg: PointCloud2) -> None:
        """Where the reflectors really are."""
        self._true_reflectors = convert.detections(msg, Parameters().reflector, TRUE_REFLECTORS)

    def on_map(self, msg: OccupancyGridMsg) -> None:
        """The newest map."""
        info = msg.info
        cells = np.frombuffer(msg.data, dtype=np.int8).reshape(info.height, info.width)
        origin = (info.origin.position.x, info.origin.position.y)
        self._grid = OccupancyGrid(round(info.resolution, 6), origin, cells)

    def on_trajectory(self, msg: Path) -> None:
        """The newest optimised trajectory."""
        stamps = [convert.stamp(p, 'trajectory') for p in msg.poses]
        poses = [convert.planar_pose(p.pose, 'trajectory') for p in msg.poses]
        self._path = Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 3))

    def on_reflectors(self, msg: PointCloud2) -> None:
        """The newest reflector map."""
        self._reflectors = read_reflector_map(msg)

    def on_graph(self, msg: MarkerArray) -> None:
        """The newest keyframes and closures."""
        for marker in msg.markers:
            points = np.array([[p.x, p.y] for p in marker.points]).reshape(-1, 2)
            if marker.ns == 'keyframes':
                self._keyframes = np.column_stack([points, np.zeros(len(points))])
            elif marker.ns == 'closure':
                self._closures = points.reshape(-1, 2, 2)

    def on_diagnostics(self, msg: DiagnosticArray) -> None:
        """Health of the front end, and the figures of both nodes."""
        for status in msg.status:
            name = status.name.rsplit('/')[-1]
            self.figures[name] = {v.key: v.value for v in status.values}
            if name == 'front_end':
                level = status.level[0] if isinstance(status.level, bytes) else status.level
                reasons = tuple(status.message.split('; ')) if level else ()
                self._health = Health(Level(min(int(level), 2)), reasons)
                if self.frames.stamps and FRAME_TIME in self.figures[name]:
                    self.frames.wall_ms.append(float(self.figures[name][FRAME_TIME]))

    def error(self) -> float | None:
        """Position error [m] of the newest pose whose truth is known."""
        for stamp, pose in zip(
            self.frames.stamps[:-10:-1], self.frames.poses[:-10:-1], strict=True
        ):
            if stamp in self.true:
                return float(np.hypot(*(pose - self.true[stamp])[:2]))
        return None

    def silence(self, now: float) -> float:
        """Seconds since the last pose, 0 before the first."""
        return now - self._heard if self._began is not None else 0.0

    def has_caught_up(self, since: float) -> bool:
        """Whether the newest scan has its pose, and the map holds all but the last LAST_MAP.

        ``since`` is when the source ended; after PATIENCE the answer is yes in any case.
        """
        if time.monotonic() - since > PATIENCE:
            return True
        newest = max(self._sensor_heard, default=0)
        mapped = self._path.stamps[-1] if len(self._path) else 0
        answered = self.frames.stamps[-1] if self.frames.stamps else 0
        return answered >= newest and mapped >= answered - LAST_MAP

    def note(self) -> str:
        """One line for the progress."""
        error = self.error()
        parts = [
            f'error {100 * error:.1f} cm' if error is not None else 'no pose yet',
            f'{len(self._reflectors)} reflectors',
            f'{len(self._keyframes)} keyframes',
            f'{len(self._closures)} closures',
        ]
        return ', '.join(parts)

    def run(self, name: str) -> Run:
        """Everything that was heard."""
        stamps = np.array(sorted(self.true), dtype=np.int64)
        truth = None
        if len(stamps):
            path = Trajectory(stamps, np.array([self.true[t] for t in sorted(self.true)]))
            known = self._true_reflectors
            truth = (
                Truth(path, True) if known is None else Truth(path, True, known.ids, known.points)
            )
        wall = 0.0 if self._began is None else self._heard - self._began
        return Run(
            name, self.frames, self.trajectory(), self._reflectors, self._grid,
            self._keyframes, self._closures, int(self._figure('back_end', 'closures rejected')),
            inputs=self.inputs(), truth=truth, wall_s=wall,
        )  # fmt: skip

    def trajectory(self) -> Trajectory:
        """The newest trajectory, and for the scans before and after it the live poses."""
        live, path = self.frames.trajectory(), self._path
        if not len(path):
            return live
        head, tail = live.stamps < path.stamps[0], live.stamps > path.stamps[-1]
        return Trajectory(
            np.concatenate([live.stamps[head], path.stamps, live.stamps[tail]]),
            np.concatenate([live.poses[head], path.poses, live.poses[tail]]),
        )

    def _figure(self, node: str, key: str) -> float:
        return float(self.figures.get(node, {}).get(key, 0))

    def inputs(self, node: str = 'front_end') -> dict[str, dict[str, int]]:
        """What became of a node's inputs, from its diagnostics."""
        out: dict[str, dict[str, int]] = {}
        for key, value in self.figures.get(node, {}).items():
            stream, _, what = key.partition(' ')
            if what and value.isdecimal() and stream in ('scan', 'odom', 'imu', 'reflectors'):
                fate = out.setdefault(stream, {'used': 0, 'late': 0, 'invalid': 0})
                fate[what] = int(value)
        return out
