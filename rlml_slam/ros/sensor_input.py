# SPDX-License-Identifier: Apache-2.0
"""Messages of the sensors go into the system: the one way for live nodes and for bags."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.params import Node, Parameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.decode import frame
from rlml_slam.ros.codecs.device_reflectors import as_poses, is_device
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.ros.tf_odometry import TfOdometry
from rlml_slam.se2 import Array
from rlml_slam.sensing.mirror import mirrored_detections, mirrored_scan
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.types import ANONYMOUS, Detections, Imu, Odometry, Scan

Out = TypeVar('Out')
MANY, MOST = 20, 0.7  # rows, and the share that is near to the next one only in a scan
# stream of the sequencer -> parameter with the topic's name, type, whether the only topic of the
# type may stand in, bytes of a beam or reflector with whatever else a driver says of it (without,
# only small messages are taken). Any PointCloud2 or PoseArray may be something else.
STREAMS: Mapping[str, tuple[str, str, bool, int]] = {
    'scan': ('scan_topic', 'sensor_msgs/msg/LaserScan', True, 8),
    'odom': ('odom_topic', 'nav_msgs/msg/Odometry', True, 0),
    'imu': ('imu_topic', 'sensor_msgs/msg/Imu', True, 0),
    'reflectors': ('reflectors_topic', 'sensor_msgs/msg/PointCloud2', False, 256),
    'reflector_poses': ('reflector_poses_topic', 'geometry_msgs/msg/PoseArray', False, 56),
    'reflector_markers': (
        'reflector_markers_topic', 'visualization_msgs/msg/MarkerArray', False, 1024),
    'reflector_beams': (
        'reflector_beams_topic', 'sick_safetyscanners2_interfaces/msg/ExtendedLaserScan', False,
        16),
    'landmarks': ('landmarks_topic', 'cartographer_ros_msgs/msg/LandmarkList', False, 256),
}  # fmt: skip
# streams of reflectors
DETECTIONS = ('reflectors', 'reflector_poses', 'reflector_markers', 'reflector_beams', 'landmarks')
USED_BY = {
    'scan': 'use_scan', 'odom': 'use_odom', 'imu': 'use_imu',
    **dict.fromkeys(DETECTIONS, 'use_reflectors'),
}  # fmt: skip
TF = 'tf'  # the stream of /tf, which every node and every bag has besides
PLACED = ('scan', *DETECTIONS)  # streams whose sensor has to have a place


def counted_as(stream: str) -> str:
    """The name under which inputs of a stream are counted: one for all that bring reflectors."""
    return 'reflectors' if stream in DETECTIONS else stream


def topics_of(node: Node, stream: str) -> tuple[str, ...]:
    """Names of the topics of a stream: one, but of as many scans as there are lidars."""
    several = tuple(filter(None, node.scan_topics)) if stream == 'scan' else ()
    return several or (str(getattr(node, STREAMS[stream][0])),)


def placement_problems(
    node: Node, assumed: Collection[str], frame_of: Mapping[str, str]
) -> list[str]:
    """What is wrong with the places of lasers, in words.

    ``assumed`` are frames without a transform, ``frame_of`` the frame of each topic of scans.
    """
    by_frame = defaultdict[str, list[str]](list)
    for topic, name in sorted(frame_of.items()):
        by_frame[name].append(topic)
    is_given = any(node.laser_pose) or node.laser_upside_down
    guessed = () if is_given else sorted(by_frame.keys() & set(assumed))
    out = [f'no transform to {name!r}: it is taken to sit at base_frame' for name in guessed]
    return out + [
        f'scans of {" and ".join(topics)} are all in the frame {name!r}: each laser needs its own'
        for name, topics in by_frame.items()
        if len(topics) > 1
    ]


class Target(Protocol[Out]):
    """A Synchronizer, whose answers are observations, or a Slam, whose answers are frames."""

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Where a sensor sits."""

    def add_odometry(self, sample: Odometry) -> list[Out]:
        """One wheel odometry sample."""

    def add_transform(self, sample: Odometry) -> list[Out]:
        """The pose of base in odom as it is on /tf."""

    def add_imu(self, sample: Imu) -> list[Out]:
        """One IMU sample."""

    def add_scan(self, scan: Scan) -> list[Out]:
        """One sweep."""

    def add_detections(self, detections: Detections) -> list[Out]:
        """The reflectors of one instant."""


class SensorInput(Generic[Out]):
    """Converts the messages of the streams (keys of STREAMS) and hands them to a target.

    ``extrinsics`` is filled by the caller from /tf_static, and here from /tf; a sensor that it
    does not know gets the parameters ``laser_pose`` and ``laser_upside_down``. A message that
    cannot be believed is counted in ``inputs``; only a clock that jumped back raises InputError.
    """

    def __init__(self, params: Parameters, target: Target[Out], inputs: InputCounts) -> None:
        self._p = params
        self._target = target
        self._inputs = inputs
        self.use_extrinsics(Extrinsics())
        self._placed = {params.node.base_frame}
        self.odom_frames = ('', '')  # of the topic's newest message
        self._named: set[str] = set()  # streams whose ids are more than numbers of rows

    def use_extrinsics(self, tree: Extrinsics) -> None:
        """Take over the transforms that are known."""
        n = self._p.node
        self.extrinsics = tree
        self.tf = TfOdometry(tree, frame(n.odom_frame), frame(n.base_frame), frame(n.map_frame))

    def add(self, stream: str, msg: Any) -> list[Out]:
        """One message of a stream; what became ready by it."""
        if stream == TF:
            return [out for t in msg.transforms for out in self._add_transform(t)]
        try:
            if is_device(msg):
                msg = as_poses(msg, self._p.node.max_beams)
            if stream in PLACED:
                self.is_placed(msg)
            sample = self._converted(stream, msg)
        except InputError as e:
            self._inputs.count(counted_as(stream), 'invalid', str(e))
            return []
        if isinstance(sample, Scan):
            return self._target.add_scan(sample)
        if isinstance(sample, Detections):
            return self._target.add_detections(sample)
        if isinstance(sample, Imu):
            return self._target.add_imu(sample)
        return self._target.add_odometry(sample)

    def _add_transform(self, msg: Any) -> list[Out]:
        """One transform by itself: a bad one costs none of the others of its message."""
        try:
            poses = self.tf.add(msg)
        except InputError as e:
            self._inputs.count(TF, 'invalid', str(e))
            return []
        return [out for pose in poses for out in self._target.add_transform(pose)]

    def is_placed(self, msg: Any) -> bool:
        """Whether the place of the message's sensor is known; InputError if it is not planar."""
        sensor = frame(msg.header.frame_id)
        if sensor not in self._placed:
            pose = self.extrinsics.pose(self._p.node.base_frame, sensor)
            if pose is None:
                return False
            self._target.set_sensor_pose(sensor, pose)
            self._placed.add(sensor)
        return True

    def hangs(self, sensor: str) -> bool:
        """Whether a sensor hangs upside down, by /tf_static or else by the parameter."""
        base = self._p.node.base_frame
        if sensor == base or self.extrinsics.up(base, sensor) is None:
            return sensor != base and self._p.node.laser_upside_down
        return self.extrinsics.hangs(base, sensor)

    def _converted(self, stream: str, msg: Any) -> Odometry | Imu | Scan | Detections:
        n, size = self._p.node, decode.size(msg)
        what = 'beams' if stream == 'scan' else 'reflectors'
        most = n.max_beams if stream == 'scan' else n.max_reflectors
        if size > most:
            raise InputError(f'{stream}: {size} {what}, more than max_{what}, {most}')
        if stream == 'scan':
            scan = decode.scan(msg)
            return mirrored_scan(scan) if self.hangs(scan.frame_id) else scan
        if stream == 'odom':
            return self._odometry(msg)
        if stream == 'imu':
            up = self.extrinsics.up(self._p.node.base_frame, frame(msg.header.frame_id))
            return decode.imu(msg, up=up)
        read = decode.detections_of_poses if hasattr(msg, 'poses') else decode.detections
        seen = self._with_names(stream, read(msg, self._p.reflector), size)
        self._check_apart(stream, seen)
        return mirrored_detections(seen) if self.hangs(seen.frame_id) else seen

    def _check_apart(self, stream: str, seen: Detections) -> None:
        """Raise InputError where most rows without id are too near to the next: it is a scan."""
        points, apart = seen.points[seen.ids == ANONYMOUS], self._p.reflector.min_separation
        steps = np.hypot(*np.diff(points, axis=0).T)
        steps = steps[steps > 0.0]  # the others are there twice, or fill the cloud up
        near = int(np.sum(steps < apart))
        if len(steps) >= MANY and near > MOST * len(steps):
            raise InputError(
                f'{stream}: {near} of {len(points)} points are less than {apart:g} m from the '
                'next one: they are of a scan, not reflectors'
            )

    def _with_names(self, stream: str, seen: Detections, size: int) -> Detections:
        """The detections, without ids while they may be the numbers of the rows of each message.

        Such ids grow from row to row, and none is larger than the number of rows, ``size``.
        """
        known = seen.ids[seen.ids != ANONYMOUS]
        if len(known) and ((np.diff(known) <= 0).any() or known[-1] > size):
            self._named.add(stream)
        if stream in self._named or self._p.node.trust_ids:
            return seen
        return replace(seen, ids=np.full(len(seen), ANONYMOUS, dtype=np.int64))

    def _odometry(self, msg: Any) -> Odometry:
        """The topic's pose, of base: by way of the static transforms where it has another child.

        A pose in the map is no odometry, and one in the local frame is our own output.
        """
        n, sample = self._p.node, decode.odometry(msg)
        parent, child = frame(msg.header.frame_id), frame(msg.child_frame_id)
        self.odom_frames = parent, child
        if parent in (n.map_frame, n.local_frame) and parent != n.odom_frame:
            raise InputError(
                f'odom: header.frame_id is {parent!r}, which is no frame of odometry: set '
                f'odom_topic to a topic in {n.odom_frame!r}'
            )
        if child in ('', n.base_frame):
            return sample
        T_child_base = self.extrinsics.pose(child, n.base_frame)
        if T_child_base is None:
            return sample
        return Odometry(sample.stamp, se2.compose(sample.pose, T_child_base))

    def odometry_problems(self) -> tuple[str, ...]:
        """What is wrong with the frames of the odometry that is used, in words."""
        n, (parent, child) = self._p.node, self.odom_frames
        if not n.use_odom or self.tf.path:
            return ()
        out = []
        if n.odom_source == 'tf' and not n.provide_odom_frame:
            out.append(f'/tf has no transform from {n.odom_frame} to {n.base_frame}')
        if parent not in ('', n.odom_frame):
            out.append(f'odometry is in the frame {parent}, odom_frame is {n.odom_frame}')
        base = frame(n.base_frame)
        if child not in ('', base) and self.extrinsics.pose(child, base) is None:
            out.append(f'odometry is of {child}, and no transform leads to {base}')
        return tuple(out)
