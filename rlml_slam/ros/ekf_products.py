# SPDX-License-Identifier: Apache-2.0
"""What ekf_slam publishes of its map: grid, trajectory and landmarks, as the back end does."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.params import Node
from rlml_slam.ros import build
from rlml_slam.ros.associated import build_reflector_map
from rlml_slam.ros.markers import reflector_markers
from rlml_slam.ros.messages import make_rclpy, rclpy_class
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.se2 import Array
from rlml_slam.types import Frame

MAX_SHARE = 0.1  # of the time may be spent on pictures of the map, however large it grows
TOPICS = {
    'map': 'nav_msgs/msg/OccupancyGrid',
    'trajectory': 'nav_msgs/msg/Path',
    'reflector_map': 'visualization_msgs/msg/MarkerArray',
    'reflector_map_points': 'sensor_msgs/msg/PointCloud2',
}


class EkfProducts:
    """Publishes the map every ``map_update_interval`` of stamps, latched."""

    def __init__(self, node: Any, params: Node) -> None:
        self._p = params
        self._publishers = {
            topic: node.create_publisher(rclpy_class(kind), topic, LATCHED)
            for topic, kind in TOPICS.items()
        }
        self.restart()

    def restart(self) -> None:
        """The next frame is due."""
        self._next = 0

    def is_due(self, stamp: int) -> bool:
        """Whether the interval has passed."""
        return stamp >= self._next

    def update(self, estimator: Estimator, stamp: int) -> None:
        """Publish where it is time to."""
        if self.is_due(stamp):
            self.publish(estimator, stamp)

    def publish(self, estimator: Estimator, stamp: int) -> None:
        """Send everything that there is."""
        began = time.perf_counter()
        make, frame = make_rclpy, self._p.map_frame
        grid, landmarks = estimator.occupancy_grid(), estimator.reflectors()
        if grid is not None:
            self._send('map', build.occupancy_grid(make, stamp, frame, grid))
        self._send('reflector_map', reflector_markers(make, stamp, frame, landmarks))
        self._send('reflector_map_points', build_reflector_map(make, stamp, frame, landmarks))
        stamps, poses = estimator.trajectory()
        self._send('trajectory', build.path(make, stamp, frame, stamps.tolist(), poses))
        wait = max(self._p.map_update_interval, (time.perf_counter() - began) / MAX_SHARE)
        self._next = stamp + int(wait * 1e9)

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)


def map_to_odom(frame: Frame) -> Array:
    """T_map_odom (3,) at a frame; without odometry, odom is the map."""
    T_odom_base = frame.observation.odom_pose
    if T_odom_base is None:
        return np.zeros(3)
    return se2.compose(frame.T_map_base, se2.inverse(T_odom_base))
