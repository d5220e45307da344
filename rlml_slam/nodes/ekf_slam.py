# SPDX-License-Identifier: Apache-2.0
"""Executable ``ekf_slam``: EKF-SLAM with the topics of front_end and back_end."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from rlml_slam.ekf.estimator import Estimator
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import EkfParameters
from rlml_slam.ros.back_end.map_transform import MapTransform
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.declare import pace
from rlml_slam.ros.diagnostics import HealthPublisher, map_id
from rlml_slam.ros.front_end.frame_publisher import FramePublisher
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.map_publisher import TOPICS, MapPublisher
from rlml_slam.ros.message_guard import Listener
from rlml_slam.ros.run import run
from rlml_slam.ros.sensor_input import STREAMS
from rlml_slam.ros.sensors import RELIABLE, Sensors
from rlml_slam.ros.systems.ekf_services import EkfServices
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import ANY, SessionFrame
from rlml_slam.types import Observation


class EkfSlamNode(ManagedNode):
    """Drives an Estimator with the robot's sensors; all stamps are those of the input."""

    def __init__(self, **options: Any) -> None:
        super().__init__('ekf_slam', EkfParameters, **options)

    def build(self) -> None:
        """The filter with its topics and services; a saved map is read."""
        n = self.params.node
        self.estimator = Estimator(self.params)
        self.map_services = EkfServices(self, n, self.estimator, self.restart_in)
        self.answers = FramePublisher(self, n)
        self.products = MapPublisher(self, n, TOPICS)
        self.tf = MapTransform(self, n)
        timer = self.every(n.transform_publish_period or 0.1, self.tf.repeat)
        self.checks['transform_publish_period'] = pace(timer)
        self.sensors = Sensors(self, self.params, STREAMS, self.process, self.restart)
        self.health = HealthPublisher(
            self, self.sensors, lambda: {'map id': map_id(self.map_services.saved)}
        )
        Listener(self, PoseWithCovarianceStamped, 'initialpose', self.start_at, RELIABLE)
        self.restart_in(self.map_services.saved)

    def process(self, observation: Observation) -> None:
        """One observation: estimate, publish, and map to odom."""
        frame = self.answers.with_odometry(self.estimator.process(observation))
        self.answers.publish(SessionFrame(ANY, frame))
        self.health.update(frame)
        self.tf.follow(frame)
        if self.products.is_due(frame.stamp):
            self.products.publish(self.estimator, None, frame.stamp)

    def start_at(self, msg: PoseWithCovarianceStamped) -> None:
        """Restart at a pose of the map."""
        start = decode.start_pose(msg, self.params.node.map_frame)
        self._begin(start.pose, start.cov, self.map_services.saved)

    def restart(self, _: bool) -> None:
        """Forget everything but a saved map."""
        self.restart_in(self.map_services.saved)

    def restart_in(self, saved: SavedMap | None) -> None:
        """Begin at map_start_pose, in a saved map or without one."""
        self._begin(np.array(self.params.node.map_start_pose), np.zeros((3, 3)), saved)

    def _begin(self, pose: Array, cov: Array, saved: SavedMap | None) -> None:
        self.estimator.reset(pose, cov)
        if saved is not None:
            self.estimator.use_map(saved.reflectors)
        self.answers.begin_session()
        self.tf.restart()
        self.products.restart()


def main() -> int:
    """Run the node."""
    return run(EkfSlamNode)


if __name__ == '__main__':
    sys.exit(main())
