# SPDX-License-Identifier: Apache-2.0
"""What carrier_simulator says, as messages."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rlml_lab.carrier.carrier import CarrierStep
from rlml_lab.carrier.carrier_parameters import CarrierParameters
from rlml_slam.deformable.window import CarrierVelocity, Features
from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import Make, make_rclpy, rclpy_class
from rlml_slam.ros.codecs.point_cloud import read_cloud
from rlml_slam.ros.systems.deformable_messages import FEATURE
from rlml_slam.se2 import compose
from rlml_slam.simulation.simulation import START
from rlml_slam.types import Detections

# topic -> type, depth, whether it is sensor data, best effort
TOPICS = {
    'carrier_velocity': ('geometry_msgs/msg/TwistStamped', 10, False),
    'odom': ('nav_msgs/msg/Odometry', 50, False),
    'reflectors': ('sensor_msgs/msg/PointCloud2', 5, True),
    'ground_truth': ('nav_msgs/msg/Odometry', 10, False),
    'ground_truth_features': ('sensor_msgs/msg/PointCloud2', 10, False),
}


class CarrierMessages:
    """Turns the steps of one simulation into messages; adds up the odometry."""

    def __init__(self, make: Make, parameters: CarrierParameters) -> None:
        self._make = make
        self._p = parameters.node
        self._odom = np.zeros(3)

    def __call__(self, step: CarrierStep, after: CarrierStep) -> list[tuple[str, Any]]:
        """(topic, message) of a step; ``after`` announces the next velocity of the carrier."""
        make, p, stamp = self._make, self._p, START + step.stamp
        self._odom = compose(self._odom, step.motion.delta)
        velocity = CarrierVelocity(after.linear, after.angular)
        seen = replace(step.detections, stamp=stamp, frame_id=p.base_frame)
        none = np.zeros((3, 3))
        truth = (p.map_frame, p.base_frame)
        return [
            ('carrier_velocity', build_velocity(make, stamp, p.map_frame, velocity)),
            ('odom', encode.odometry(make, stamp, (p.odom_frame, p.base_frame), self._odom, none)),
            ('reflectors', encode.detections(make, seen)),
            ('ground_truth', encode.odometry(make, stamp, truth, step.pose, none)),
            ('ground_truth_features', self._features(stamp, step)),
        ]

    def _features(self, stamp: int, step: CarrierStep) -> Any:
        n = len(step.ids)
        known = Detections(
            stamp, self._p.map_frame, step.points, np.zeros((n, 2, 2)), step.ids,
            np.full(n, np.nan),
        )  # fmt: skip
        return encode.detections(self._make, known)


class CarrierTopics:
    """The publishers of carrier_simulator."""

    def __init__(self, node: Any, parameters: CarrierParameters) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        self._messages = CarrierMessages(make_rclpy, parameters)
        self._publishers: dict[str, Any] = {}
        for topic, (kind, depth, sensor) in TOPICS.items():
            qos = QoSProfile(depth=depth)
            if sensor:
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            self._publishers[topic] = node.create_publisher(rclpy_class(kind), topic, qos)
        self._clock = node.create_publisher(rclpy_class('rosgraph_msgs/msg/Clock'), '/clock', 10)

    def listeners(self, topic: str) -> int:
        """Number of subscriptions that a topic has."""
        return int(self._publishers[topic].get_subscription_count())

    def publish(self, step: CarrierStep, after: CarrierStep) -> None:
        """Send everything of one step, the time first."""
        self._clock.publish(encode.clock(make_rclpy, START + step.stamp))
        for topic, message in self._messages(step, after):
            self._publishers[topic].publish(message)


def build_velocity(make: Make, time: int, axes: str, velocity: CarrierVelocity) -> Any:
    """TwistStamped; the inverse of read_velocity."""
    return make(
        'geometry_msgs/msg/TwistStamped',
        header=encode.header(make, time, axes),
        twist=encode.velocity(make, np.append(velocity.linear, velocity.angular)),
    )


def read_features(msg: Any, topic: str = 'features') -> Features:
    """The inverse of build_features; InputError if it is another kind of cloud."""
    cloud = read_cloud(msg, topic)
    missing = set(FEATURE.names or ()) - set(cloud.dtype.names or ())
    if missing:
        raise InputError(f'{topic}: cloud has no field {", ".join(sorted(missing))}')
    cov = np.stack([cloud['cov_xx'], cloud['cov_xy'], cloud['cov_xy'], cloud['cov_yy']], -1)
    return Features(
        cloud['key'].astype(np.int64),
        cloud['id'].astype(np.int64),
        np.stack([cloud['x'], cloud['y']], -1).astype(np.float64),
        cov.astype(np.float64).reshape(-1, 2, 2),
    )
