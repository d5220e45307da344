# SPDX-License-Identifier: Apache-2.0
"""Topics by which the back end commands the front end, and reports what it does."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Node
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.correction_message import build_correction
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import build_reflector_map
from rlml_slam.ros.codecs.request_message import build_request
from rlml_slam.ros.codecs.update_message import build_update
from rlml_slam.ros.sensors import ALIVE, LATCHED
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import Update
from rlml_slam.slam.conversation import Correct, FrontEndCommand, LocalizeIn

CERTAIN = 1e-6 * np.eye(3)


class MapTopics:
    """Publishers of single facts; the pictures of the map are in map_publisher.py."""

    def __init__(self, node: Any, params: Node) -> None:
        self._map, self._base = params.map_frame, params.base_frame
        pose = rclpy_class('geometry_msgs/msg/PoseWithCovarianceStamped')
        cloud = rclpy_class('sensor_msgs/msg/PointCloud2')
        grid = rclpy_class('nav_msgs/msg/OccupancyGrid')
        self._correction = node.create_publisher(pose, 'correction', LATCHED)
        self._jumps = node.create_publisher(pose, 'jumps', 10)
        self._requests = node.create_publisher(cloud, 'rlml/session_start', 10)
        self._graph = node.create_publisher(cloud, 'rlml/graph_correction', ALIVE)
        self._updates = node.create_publisher(cloud, 'updates', 50)
        self._grid = node.create_publisher(grid, 'rlml/localization_grid', LATCHED)
        self._reflectors = node.create_publisher(cloud, 'rlml/localization_map', LATCHED)
        text = rclpy_class('std_msgs/msg/String')
        self._entry = node.create_publisher(text, 'rlml/map_entry', LATCHED)
        self._problem: str | None = None  # the newest that was published there

    def show_entry(self, problem: str) -> None:
        """Why poses are not in the map that is to be continued, '' where they are."""
        if problem != self._problem:
            self._problem = problem
            self._entry.publish(make_rclpy('std_msgs/msg/String', data=problem))

    def show_alive(self) -> None:
        """Let front ends know that this back end runs."""
        self._graph.assert_liveliness()

    def send(self, command: FrontEndCommand) -> None:
        """A command for the front end."""
        if isinstance(command, Correct):
            self._graph.publish(build_correction(make_rclpy, command, self._map))
        elif isinstance(command, LocalizeIn):
            self._localize_in(command.number, command.map)
        else:
            self._requests.publish(build_request(make_rclpy, command, self._map))

    def correct(self, stamp: int, T_map_local: Array, cov_map: Array | None = None) -> None:
        """The local frame in the map, with the covariance of the pose at this stamp in the map."""
        cov = CERTAIN if cov_map is None else cov_map
        self._correction.publish(self._pose(stamp, self._map, T_map_local, cov))

    def jump(self, stamp: int, jump: Array) -> None:
        """By what (3,) the pose in the map jumped, in the axes of the robot."""
        self._jumps.publish(self._pose(stamp, self._base, jump, np.zeros((3, 3))))

    def update(self, stamp: int, place: Array, update: Update) -> None:
        """What the newest frame changed, and the ``place`` (2,) of its keyframe in the map."""
        self._updates.publish(build_update(make_rclpy, stamp, self._map, place, update))

    def _localize_in(self, number: int, saved: SavedMap | None) -> None:
        """The map to localize in, without cells where it has no grid; or a cloud without fields.

        The number takes the place of both stamps, so that parts of two maps are not mixed.
        """
        none = OccupancyGrid(1.0, (0.0, 0.0), np.zeros((0, 0), dtype=np.int8))
        grid = none if saved is None or saved.grid is None else saved.grid
        self._grid.publish(encode.occupancy_grid(make_rclpy, number, self._map, grid))
        if saved is None:
            header = encode.header(make_rclpy, number, self._map)
            cloud = make_rclpy('sensor_msgs/msg/PointCloud2', header=header)
        else:
            cloud = build_reflector_map(make_rclpy, number, self._map, saved.reflectors)
        self._reflectors.publish(cloud)

    @staticmethod
    def _pose(stamp: int, frame: str, pose: Array, cov: Array) -> Any:
        return encode.pose_with_covariance(make_rclpy, stamp, frame, pose, cov)
