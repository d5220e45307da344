# SPDX-License-Identifier: Apache-2.0
"""What a system publishes of its map: grid, trajectory, reflectors and, with one, its graph."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import MapError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Node
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.graph_markers import graph_markers
from rlml_slam.ros.codecs.markers import reflector_markers
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import build_reflector_map
from rlml_slam.ros.codecs.serialized_path import serialized_path
from rlml_slam.ros.memory import give_back
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.se2 import Array
from rlml_slam.types import Reflectors

MAX_SHARE = 0.2  # of the time may be spent on pictures of the map, however large it grows
TOPICS = {
    'map': 'nav_msgs/msg/OccupancyGrid',
    'map_metadata': 'nav_msgs/msg/MapMetaData',
    'trajectory': 'nav_msgs/msg/Path',
    'reflector_map': 'visualization_msgs/msg/MarkerArray',
    'reflector_map_points': 'sensor_msgs/msg/PointCloud2',
}
GRAPH = {'graph': 'visualization_msgs/msg/MarkerArray'}


class Mapped(Protocol):
    """A system with a map; one that has a ``graph`` shows it."""

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The map of the scans, None without any."""

    def reflectors(self) -> Reflectors:
        """The reflector map."""

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3)."""


class MapPublisher:
    """Publishes the map every ``map_update_interval`` of stamps, latched.

    ``stamp`` is that of the newest map that was sent, 0 before the first. ``undrawn`` says why the
    newest grid could not be drawn, empty where it could; then everything else is sent.
    """

    def __init__(
        self, node: Any, params: Node, topics: Mapping[str, str] = {**TOPICS, **GRAPH}
    ) -> None:
        self._p = params
        self._logger = node.get_logger()
        self._publishers = {
            topic: node.create_publisher(rclpy_class(kind), topic, LATCHED)
            for topic, kind in topics.items()
        }
        self.restart()

    def restart(self) -> None:
        """The next frame is due."""
        self.stamp = 0
        self.undrawn = ''
        self._warned = False
        self._rested = 0.0

    def is_due(self, stamp: int) -> bool:
        """Whether the interval has passed, and the pause that the last map's cost asks for."""
        due = self.stamp + int(self._p.map_update_interval * 1e9) if self.stamp else 0
        return stamp >= due and time.monotonic() >= self._rested

    def grid(self, source: Mapped) -> OccupancyGrid | None:
        """The system's grid; None, with one warning, where it is too large to be drawn."""
        try:
            grid, self.undrawn = source.occupancy_grid(), ''
        except MapError as e:
            grid, self.undrawn = None, str(e)
            if not self._warned:
                self._logger.warning(f'no grid: {e}')
                self._warned = True
        return grid

    def publish(self, source: Mapped, saved: SavedMap | None, stamp: int) -> None:
        """Send everything that there is: of the system, or of a saved map."""
        began = time.monotonic()
        make, frame = make_rclpy, self._p.map_frame
        grid = self.grid(source) if saved is None else saved.grid
        reflectors = source.reflectors() if saved is None else saved.reflectors
        if grid is not None:
            self._send('map', encode.occupancy_grid(make, stamp, frame, grid))
            self._send('map_metadata', encode.map_metadata(make, stamp, grid))
        self._send('reflector_map', reflector_markers(make, stamp, frame, reflectors))
        self._send('reflector_map_points', build_reflector_map(make, stamp, frame, reflectors))
        if saved is None:
            stamps, poses = source.trajectory()
            self._send('trajectory', serialized_path(stamp, frame, stamps, poses))
            graph = getattr(source, 'graph', None)
            if graph is not None:
                self._send('graph', graph_markers(make, stamp, frame, graph))
        give_back()
        self.stamp = stamp
        now = time.monotonic()
        self._rested = now + (now - began) * (1.0 / MAX_SHARE - 1.0)

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)
