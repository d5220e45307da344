# SPDX-License-Identifier: Apache-2.0
"""What the front end publishes of a frame: poses for the robot, everything for the back end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Node
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.frame_messages import build_points, build_record
from rlml_slam.ros.codecs.markers import detection_markers
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import build_associated
from rlml_slam.ros.front_end.provided_odometry import ProvidedOdometry
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import SessionFrame
from rlml_slam.types import Frame

CLOUD = 'sensor_msgs/msg/PointCloud2'
TOPICS = {
    'pose': ('geometry_msgs/msg/PoseWithCovarianceStamped', 10),
    '~/odometry': ('nav_msgs/msg/Odometry', 10),
    'deskewed_points': (CLOUD, 50),
    'reflectors/associated': (CLOUD, 50),
    'reflectors/statuses': ('visualization_msgs/msg/MarkerArray', 5),
    'rlml/frames': (CLOUD, 50),
}
SHORT = 0.005  # [s] steps of several lidars: too short for a speed
FORGOTTEN = 30.0  # [s] after which DDS has forgotten a node that was killed


class FramePublisher:
    """Publishes frames, those of the back end and of viewers only where somebody subscribes."""

    def __init__(self, node: Any, params: Node) -> None:
        self._p, self._node = params, node
        self._alone = time.monotonic()  # when no other node published the pose
        self._publishers = {
            topic: node.create_publisher(rclpy_class(kind), topic, depth)
            for topic, (kind, depth) in TOPICS.items()
        }
        self._odom = ProvidedOdometry(node, params) if params.provide_odom_frame else None
        self.begin_session()

    def with_odometry(self, frame: Frame) -> Frame:
        """The frame; where the robot has no odometry, with the one that is published for it."""
        return frame if self._odom is None else self._odom.publish(frame)

    def problems(self) -> tuple[str, ...]:
        """Another node that publishes the pose: most likely this one was started twice."""
        now, topic = time.monotonic(), self._publishers['pose'].topic_name
        found = self._node.publishers_of(topic)
        if len(found) < 2:
            self._alone = now
        if now - self._alone <= FORGOTTEN:
            return ()
        return (f'{topic} has {len(found)} publishers, was it started twice: {", ".join(found)}',)

    def begin_session(self) -> None:
        """From now on, the local frame is another one."""
        if self._odom is not None:
            self._odom.begin_session()
        self._last: Frame | None = None
        self._twisted = (np.zeros(3), np.zeros((3, 3)))

    def publish(self, record: SessionFrame) -> None:
        """Send everything of one frame, stamped as the frame."""
        p, frame, make = self._p, record.frame, make_rclpy
        observation = frame.observation
        self._publishers['pose'].publish(
            encode.pose_with_covariance(
                make, frame.stamp, p.map_frame, frame.T_map_base, frame.cov_map
            )
        )
        twist, twist_cov = self._twist(frame)
        frames = (p.local_frame, p.base_frame)
        self._publishers['~/odometry'].publish(
            encode.odometry(
                make, frame.stamp, frames, frame.T_local_base, frame.cov_local, twist, twist_cov
            )
        )
        if observation.points is not None:
            points = frame.stamp, p.base_frame, observation.points
            self._send_if_heard('deskewed_points', build_points, *points)
        if observation.detections is not None:
            self._send_if_heard('reflectors/associated', build_associated, frame, p.base_frame)
            seen = frame.stamp, p.base_frame, observation.detections.points, frame.statuses
            self._send_if_heard('reflectors/statuses', detection_markers, *seen)
        self._send_if_heard('rlml/frames', build_record, record, p.local_frame)
        self._last = frame

    def _send_if_heard(self, topic: str, build: Callable[..., Any], *of: Any) -> None:
        """Build and send a message, where somebody subscribes."""
        if self._publishers[topic].get_subscription_count() > 0:
            self._publishers[topic].publish(build(make_rclpy, *of))

    def _twist(self, frame: Frame) -> tuple[Array, Array]:
        """Body twist since the last frame, with the covariance of the motion model.

        A pose after relocalization is no motion: the last twist is kept.
        """
        dt = 0.0 if self._last is None else (frame.stamp - self._last.stamp) * 1e-9
        if self._last is not None and dt >= SHORT and not frame.jumped:
            step = se2.log(se2.between(self._last.T_local_base, frame.T_local_base))
            self._twisted = (step / dt, frame.observation.motion.cov / dt**2)
        return self._twisted
