# SPDX-License-Identifier: Apache-2.0
"""What the simulator says, as messages: the same for the node and for bags."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.params import SimulatorParameters
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import Make, make_rclpy, rclpy_class
from rlml_slam.ros.tf import TF_MESSAGE
from rlml_slam.se2 import Array
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START, Event, GroundTruth, Message, Simulation
from rlml_slam.types import Detections, Health, Imu, Odometry, Scan

# topic (relative) -> type, depth of its queue
TOPICS = {
    'odom': ('nav_msgs/msg/Odometry', 50),
    'imu': ('sensor_msgs/msg/Imu', 50),
    'scan': ('sensor_msgs/msg/LaserScan', 5),
    'reflectors': ('sensor_msgs/msg/PointCloud2', 5),
    'ground_truth': ('nav_msgs/msg/Odometry', 10),
}
SENSOR_TOPICS = ('odom', 'imu', 'scan', 'reflectors')
BEST_EFFORT = SENSOR_TOPICS[1:]  # a subscriber with default settings hears the odometry too
# latched: where the reflectors really are, in the map frame
TRUE_REFLECTORS = 'ground_truth_reflectors'
SETTLE = 0.5  # [s] from the last subscriber to the begin of time


class SimulatedMessages:
    """Turns the messages of one simulation into ROS's; keeps the odometry for its twist."""

    def __init__(self, make: Make, parameters: SimulatorParameters) -> None:
        self._make = make
        self._p = parameters
        self._last: Odometry | None = None

    def __call__(self, message: Message) -> tuple[str, Any]:
        """Topic (relative) and message."""
        make, n = self._make, self._p.node
        if isinstance(message, Odometry):
            return 'odom', self._odometry(message)
        if isinstance(message, Imu):
            gyro = self._p.gyro
            rate = abs(message.yaw_rate)
            variance = (
                (gyro.turn_noise * rate + gyro.turn_noise_floor) ** 2
                * gyro.noise_interval
                * gyro.rate
            )
            return 'imu', encode.imu(make, message, n.base_frame, variance)
        if isinstance(message, Scan):
            return 'scan', encode.laser_scan(make, message, 1.0 / self._p.laser.rate)
        if isinstance(message, Detections):
            return 'reflectors', encode.detections(make, message)
        return 'ground_truth', self._truth(message)

    def odom_transform(self, sample: Odometry) -> Any:
        """TFMessage of odom to base."""
        n = self._p.node
        return self._transform(sample.stamp, (n.odom_frame, n.base_frame), sample.pose)

    def laser_transform(self) -> Any:
        """TFMessage of base to laser."""
        n = self._p.node
        return self._transform(START, (n.base_frame, n.laser_frame), np.array(n.laser_pose))

    def _transform(self, stamp: int, frames: tuple[str, str], T: Array) -> Any:
        return encode.tf_message(self._make, [encode.transform(self._make, stamp, frames, T)])

    def _truth(self, truth: GroundTruth) -> Any:
        n = self._p.node
        frames = (n.map_frame, n.base_frame)
        none = np.zeros((3, 3))
        return encode.odometry(
            self._make, truth.stamp, frames, truth.T_map_base, none, truth.twist, none
        )

    def _odometry(self, sample: Odometry) -> Any:
        """Twist from the step before; the pose's covariance grows without bound: left at 0."""
        n, last = self._p.node, self._last
        self._last = sample
        twist = np.zeros(3)
        if last is not None and sample.stamp > last.stamp:
            dt = (sample.stamp - last.stamp) / SECOND
            twist = se2.log(se2.between(last.pose, sample.pose)) / dt
        return encode.odometry(
            self._make,
            sample.stamp,
            (n.odom_frame, n.base_frame),
            sample.pose,
            np.zeros((3, 3)),
            twist,
            self._twist_cov(twist),
        )

    def _twist_cov(self, twist: Array) -> Array:
        w = self._p.wheels
        scale = w.noise_interval * w.rate
        v, omega = abs(twist[0]), abs(twist[2])
        sigmas = np.array(
            [
                w.speed_noise * v + w.speed_noise_floor,
                w.lateral_noise * v,
                w.turn_noise * omega + w.turn_noise_floor,
            ]
        )
        cov: Array = np.diag(sigmas**2 * scale)
        return cov

    def true_reflectors(self, simulation: Simulation) -> Any:
        """PointCloud2 of all reflectors with their ids, in the map frame."""
        points, ids = simulation.true_reflectors()
        diameters = np.where(
            np.isnan(simulation.world.reflectors.normals), simulation.world.reflectors.widths,
            math.nan,
        )  # fmt: skip
        known = Detections(
            START, self._p.node.map_frame, points, np.zeros((len(ids), 2, 2)), ids, diameters
        )
        return encode.detections(self._make, known)


class SimulatedTopics:
    """The publishers of the simulator node; what never changes is published at once, latched."""

    def __init__(self, node: Any, simulation: Simulation) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        self._heard: float | None = None
        self._messages = SimulatedMessages(make_rclpy, simulation.parameters)
        self._publishers: dict[str, Any] = {}
        self.published = dict.fromkeys(TOPICS, 0)
        for topic, (msgtype, depth) in TOPICS.items():
            qos = QoSProfile(depth=depth)
            if topic in BEST_EFFORT:
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            self._publishers[topic] = node.create_publisher(rclpy_class(msgtype), topic, qos)
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._diagnostics = node.create_publisher(
            rclpy_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', 10
        )
        self._clock = node.create_publisher(rclpy_class('rosgraph_msgs/msg/Clock'), '/clock', 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        truth = self._messages.true_reflectors(simulation)
        node.create_publisher(type(truth), TRUE_REFLECTORS, latched).publish(truth)
        kind = rclpy_class(TF_MESSAGE)
        if kind is None:
            pose = list(simulation.parameters.node.laser_pose)
            node.get_logger().warning(
                f'tf2_msgs is not installed: give the other nodes laser_pose:={pose}'
            )
        else:
            static = node.create_publisher(kind, '/tf_static', latched)
            static.publish(self._messages.laser_transform())

    def is_heard(self, topic: str, by: int, now: float) -> bool:
        """Whether a topic has had ``by`` subscriptions for SETTLE, at the wall's time [s].

        A publisher knows its subscribers before all of them know it: the first scan would be lost.
        """
        if by == 0:
            return True
        if self._publishers[topic].get_subscription_count() < by:
            self._heard = None
            return False
        self._heard = now if self._heard is None else self._heard
        return now - self._heard >= SETTLE

    def publish_time(self, stamp: int) -> None:
        """Say on /clock what time it is."""
        self._clock.publish(encode.clock(make_rclpy, stamp))

    def publish(self, events: Iterable[Event]) -> None:
        """Send what arrived."""
        for event in events:
            topic, message = self._messages(event.message)
            self._publishers[topic].publish(message)
            self.published[topic] += 1

    def publish_clock(self, stamp: int) -> None:
        """Say on /diagnostics how many messages were published."""
        figures = {f'{topic} published': n for topic, n in self.published.items()}
        self._diagnostics.publish(
            encode.diagnostics(make_rclpy, stamp, self._name, Health(), figures)
        )
