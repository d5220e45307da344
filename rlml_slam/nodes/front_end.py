# SPDX-License-Identifier: Apache-2.0
"""Executable ``front_end``: a pose with covariance for every scan or set of detections."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from rlml_slam import se2, warm_up
from rlml_slam.params import Parameters
from rlml_slam.rlml.front_end import FrontEnd
from rlml_slam.ros import build, convert
from rlml_slam.ros.associated import build_associated, read_reflector_map
from rlml_slam.ros.declare import declare
from rlml_slam.ros.feed import STREAMS
from rlml_slam.ros.health import HealthPublisher
from rlml_slam.ros.messages import make_rclpy as make
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import LATCHED, RELIABLE, Sensors, checked
from rlml_slam.se2 import Array
from rlml_slam.types import Frame, Observation, Reflectors


class FrontEndNode(Node):
    """Drives a FrontEnd with the robot's sensors; all stamps are those of the input."""

    def __init__(self, **options: Any) -> None:
        super().__init__('front_end', **options)
        self.params: Parameters = declare(self)
        self.front_end = FrontEnd(self.params)
        warm_up.compile_loaded()
        self._last: Frame | None = None
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'pose', RELIABLE)
        self._filtered = self.create_publisher(Odometry, 'odometry/filtered', 50)
        self._associated = self.create_publisher(PointCloud2, 'reflectors/associated', 50)
        self.sensors = Sensors(self, self.params, STREAMS, self.process, self.restart)
        self.health = HealthPublisher(self, self.sensors)
        pose = PoseWithCovarianceStamped
        self.create_subscription(pose, 'initialpose', checked(self, self.start_at), RELIABLE)
        self.create_subscription(pose, 'correction', checked(self, self.correct), LATCHED)
        self._map: Reflectors | None = None
        if self.params.node.mode == 'localization':
            self.create_subscription(
                PointCloud2, 'reflector_map_points', checked(self, self.use_map), LATCHED
            )

    def process(self, observation: Observation) -> None:
        """One observation: estimate and publish."""
        frame = self.front_end.process(observation)
        n = self.params.node
        if observation.detections is not None:
            self._associated.publish(build_associated(make, frame, n.base_frame))
        twist, twist_cov = self._twist(frame)
        frames = (n.local_frame, n.base_frame)
        self._filtered.publish(
            build.odometry(
                make, frame.stamp, frames, frame.T_local_base, frame.cov_local, twist, twist_cov
            )
        )
        self._pose.publish(
            build.pose_with_covariance(
                make, frame.stamp, n.map_frame, frame.T_map_base, frame.cov_map
            )
        )
        self.health.update(frame)
        self._last = frame

    def _twist(self, frame: Frame) -> tuple[Any, Any]:
        """Body twist since the last frame, with the covariance of the motion model."""
        if self._last is None:
            return np.zeros(3), np.zeros((3, 3))
        dt = (frame.stamp - self._last.stamp) * 1e-9
        step = se2.log(se2.between(self._last.T_local_base, frame.T_local_base))
        return step / dt, frame.observation.motion.cov / dt**2

    def start_at(self, msg: PoseWithCovarianceStamped) -> None:
        """Begin anew at a pose of the map."""
        start = convert.pose_estimate(msg, 'initialpose')
        self._begin(start.pose, start.cov)
        self.get_logger().info(f'begins at {np.round(start.pose, 3).tolist()}')

    def restart(self) -> None:
        """Forget everything: the clock jumped back."""
        self._begin(np.array(self.params.node.map_start_pose), np.zeros((3, 3)))

    def use_map(self, msg: PointCloud2) -> None:
        """Localise in the saved map that the back end read, from where the robot is now."""
        self._map = read_reflector_map(msg)
        self._begin(self.front_end.state.pose, self.front_end.state.pose_cov)
        self.get_logger().info(f'localizes in a map of {len(self._map)} reflectors')

    def _begin(self, pose: Array, cov: Array) -> None:
        self.front_end.reset(pose, cov)
        if self._map is not None:
            self.front_end.use_map(self._map)
        self._last = None

    def correct(self, msg: PoseWithCovarianceStamped) -> None:
        """Take over T_map_local from the back end."""
        self.front_end.correct(convert.pose_estimate(msg, 'correction').pose)


def main() -> int:
    """Run the node."""
    return run(FrontEndNode)


if __name__ == '__main__':
    sys.exit(main())
