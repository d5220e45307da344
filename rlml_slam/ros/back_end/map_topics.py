# SPDX-License-Identifier: Apache-2.0
"""Topics by which the back end corrects the front end, and tells of what it does."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Node
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.belief_message import StampedBelief, build_belief
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import build_reflector_map
from rlml_slam.ros.codecs.update_message import build_update
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import BackEnd, Update

CERTAIN = 1e-6 * np.eye(3)


class MapTopics:
    """Publishers of single facts; the pictures of the map are in products.py."""

    def __init__(self, node: Any, params: Node) -> None:
        self._map, self._base = params.map_frame, params.base_frame
        pose = rclpy_class('geometry_msgs/msg/PoseWithCovarianceStamped')
        cloud = rclpy_class('sensor_msgs/msg/PointCloud2')
        grid = rclpy_class('nav_msgs/msg/OccupancyGrid')
        self._correction = node.create_publisher(pose, 'correction', LATCHED)
        self._jumps = node.create_publisher(pose, 'jumps', 10)
        self._initialpose = node.create_publisher(pose, 'initialpose', 10)
        self._relocation = node.create_publisher(pose, 'relocation', 10)
        self._belief = node.create_publisher(cloud, 'belief', 5)
        self._updates = node.create_publisher(cloud, 'updates', 50)
        self._grid = node.create_publisher(grid, 'localization_grid', LATCHED)
        self._reflectors = node.create_publisher(cloud, 'localization_map', LATCHED)

    def start_at(self, stamp: int, pose: Array, cov: Array = CERTAIN) -> None:
        """Let the front end begin anew at a pose (3,) of the map with covariance (3, 3)."""
        self._initialpose.publish(self._pose(stamp, self._map, pose, cov))

    def relocate(self, stamp: int, pose: Array, cov: Array) -> None:
        """Tell a lost front end where it is in the map in the making."""
        self._relocation.publish(self._pose(stamp, self._map, pose, cov))

    def correct(self, stamp: int, back_end: BackEnd) -> None:
        """The local frame in the map, with the covariance of the pose at this stamp in the map."""
        cov = CERTAIN if back_end.known is None else back_end.known.cov_map
        self._correction.publish(self._pose(stamp, self._map, back_end.T_map_local, cov))

    def jump(self, stamp: int, jump: Array) -> None:
        """By what (3,) the pose in the map jumped, in the axes of the robot."""
        self._jumps.publish(self._pose(stamp, self._base, jump, np.zeros((3, 3))))

    def update(self, stamp: int, place: Array, update: Update) -> None:
        """What the newest frame changed, and the ``place`` (2,) of its keyframe in the map."""
        self._updates.publish(build_update(make_rclpy, stamp, self._map, place, update))

    def believe(self, belief: StampedBelief) -> None:
        """What the graph knows better than the front end."""
        self._belief.publish(build_belief(make_rclpy, belief, self._map))

    def localize_in(self, stamp: int, saved: SavedMap) -> None:
        """The map that the front end is to localize in; an empty grid where it has none."""
        grid = saved.grid or OccupancyGrid(1.0, (0.0, 0.0), np.zeros((0, 0), dtype=np.int8))
        self._grid.publish(encode.occupancy_grid(make_rclpy, stamp, self._map, grid))
        cloud = build_reflector_map(make_rclpy, stamp, self._map, saved.reflectors)
        self._reflectors.publish(cloud)

    def localize_nowhere(self, stamp: int) -> None:
        """The front end is to map: a cloud without fields."""
        header = encode.header(make_rclpy, stamp, self._map)
        self._reflectors.publish(make_rclpy('sensor_msgs/msg/PointCloud2', header=header))

    @staticmethod
    def _pose(stamp: int, frame: str, pose: Array, cov: Array) -> Any:
        return encode.pose_with_covariance(make_rclpy, stamp, frame, pose, cov)
