# SPDX-License-Identifier: Apache-2.0
"""What the back end publishes of its map: grid, trajectory, reflectors and graph."""

from __future__ import annotations

import time
from typing import Any

from rlml_slam.params import Node
from rlml_slam.rlml.back_end import BackEnd
from rlml_slam.ros import build
from rlml_slam.ros.associated import build_reflector_map
from rlml_slam.ros.map_folder import SavedMap
from rlml_slam.ros.markers import graph_markers, reflector_markers
from rlml_slam.ros.messages import make_rclpy, rclpy_class
from rlml_slam.ros.sensors import LATCHED

MAX_SHARE = 0.2  # of the time may be spent on pictures of the map, however large it grows
TOPICS = {
    'map': 'nav_msgs/msg/OccupancyGrid',
    'map_metadata': 'nav_msgs/msg/MapMetaData',
    'trajectory': 'nav_msgs/msg/Path',
    'reflector_map': 'visualization_msgs/msg/MarkerArray',
    'reflector_map_points': 'sensor_msgs/msg/PointCloud2',
    'graph': 'visualization_msgs/msg/MarkerArray',
}


class MapProducts:
    """Publishes the map every ``map_update_interval`` of stamps, latched.

    ``stamp`` is that of the newest map that was sent, 0 before the first.
    """

    def __init__(self, node: Any, params: Node) -> None:
        self._p = params
        self._publishers = {
            topic: node.create_publisher(rclpy_class(kind), topic, LATCHED)
            for topic, kind in TOPICS.items()
        }
        self.restart()

    def restart(self) -> None:
        """The next frame is due."""
        self.stamp = 0
        self._next = 0
        self._rested = 0.0

    def is_due(self, stamp: int) -> bool:
        """Whether the interval has passed, and the pause that the last map's cost asks for."""
        return stamp >= self._next and time.monotonic() >= self._rested

    def publish(self, back_end: BackEnd, saved: SavedMap | None, stamp: int) -> None:
        """Send everything that there is: of the graph, or of a saved map."""
        began = time.monotonic()
        make, frame = make_rclpy, self._p.map_frame
        grid = back_end.occupancy_grid() if saved is None else saved.grid
        reflectors = back_end.reflectors() if saved is None else saved.reflectors
        if grid is not None:
            self._send('map', build.occupancy_grid(make, stamp, frame, grid))
            self._send('map_metadata', build.map_metadata(make, stamp, grid))
        self._send('reflector_map', reflector_markers(make, stamp, frame, reflectors))
        self._send('reflector_map_points', build_reflector_map(make, stamp, frame, reflectors))
        if saved is None:
            stamps, poses = back_end.trajectory()
            self._send('trajectory', build.path(make, stamp, frame, stamps.tolist(), poses))
            self._send('graph', graph_markers(make, stamp, frame, back_end.graph))
        self.stamp, self._next = stamp, stamp + int(self._p.map_update_interval * 1e9)
        now = time.monotonic()
        self._rested = now + (now - began) * (1.0 / MAX_SHARE - 1.0)

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)
