# SPDX-License-Identifier: Apache-2.0
"""Executable ``ekf_slam``: EKF-SLAM with the topics of front_end and back_end."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from std_srvs.srv import Trigger

from rlml_slam import se2, warm_up
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.errors import MapError, RlmlError
from rlml_slam.params import EkfParameters
from rlml_slam.ros import convert
from rlml_slam.ros.answers import FramePublisher
from rlml_slam.ros.declare import declare
from rlml_slam.ros.ekf_products import EkfProducts
from rlml_slam.ros.feed import STREAMS
from rlml_slam.ros.health import HealthPublisher
from rlml_slam.ros.map_folder import MapFolder, SavedMap
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import RELIABLE, Sensors, checked
from rlml_slam.ros.tf import TransformPublisher
from rlml_slam.se2 import Array
from rlml_slam.types import Observation


class EkfSlamNode(Node):
    """Drives an Estimator with the robot's sensors; all stamps are those of the input."""

    def __init__(self, **options: Any) -> None:
        super().__init__('ekf_slam', **options)
        self.params: EkfParameters = declare(self, EkfParameters)
        n = self.params.node
        self.folder = MapFolder(n.map_directory)
        self.saved = self.folder.load(n.map_file_name) if n.mode == 'localization' else None
        self.estimator = Estimator(self.params)
        warm_up.compile_loaded()
        self.answers = FramePublisher(self, n)
        self.products = EkfProducts(self, n)
        self.tf = TransformPublisher(self)
        self.sensors = Sensors(self, self.params, STREAMS, self.process, self.restart)
        self.health = HealthPublisher(self, self.sensors)
        self.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', checked(self, self.start_at), RELIABLE
        )
        self.create_service(Trigger, '~/save_map', self.save_map)
        self.create_service(Trigger, '~/reset', self.reset)
        self.restart()

    def process(self, observation: Observation) -> None:
        """One observation: estimate, publish, and map to odom."""
        frame, n = self.estimator.process(observation), self.params.node
        self.answers.publish(frame)
        self.health.update(frame)
        T_odom_base = observation.odom_pose
        if T_odom_base is None:  # without odometry, odom is the map
            T_odom_base = frame.T_map_base
        T_map_odom = se2.compose(frame.T_map_base, se2.inverse(T_odom_base))
        self.tf.publish(frame.stamp, (n.map_frame, n.odom_frame), T_map_odom)
        if self.products.is_due(frame.stamp):
            self.products.publish(self.estimator, frame.stamp)

    def start_at(self, msg: PoseWithCovarianceStamped) -> None:
        """Begin anew at a pose of the map."""
        start = convert.pose_estimate(msg, 'initialpose')
        self._begin(start.pose, start.cov)
        self.get_logger().info(f'begins at {np.round(start.pose, 3).tolist()}')

    def restart(self) -> None:
        """Forget everything but a saved map."""
        self._begin(np.array(self.params.node.map_start_pose), np.zeros((3, 3)))

    def _begin(self, pose: Array, cov: Array) -> None:
        self.estimator.reset(pose, cov)
        if self.saved is not None:
            self.estimator.use_map(self.saved.reflectors)
        self.answers.begin_session()
        self.products.restart()

    def save_map(self, _request: Any, response: Any) -> Any:
        """Write landmarks and grid under map_file_name."""
        try:
            saved = SavedMap(self.estimator.reflectors(), self.estimator.occupancy_grid())
            if not len(saved.reflectors) and saved.grid is None:
                raise MapError('there is no map yet')
            path = self.folder.save(self.params.node.map_file_name, saved)
            response.success = True
            response.message = f'{path}: {len(saved.reflectors)} landmarks'
        except RlmlError as e:
            response.success, response.message = False, str(e)
        return response

    def reset(self, _request: Any, response: Any) -> Any:
        """Forget the map and begin at map_start_pose."""
        self.restart()
        response.success, response.message = True, 'the map begins anew'
        return response


def main() -> int:
    """Run the node."""
    return run(EkfSlamNode)


if __name__ == '__main__':
    sys.exit(main())
