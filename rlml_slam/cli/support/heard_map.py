# SPDX-License-Identifier: Apache-2.0
"""The newest map, trajectory and graph of a live system, bytes until they are wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message
from visualization_msgs.msg import MarkerArray

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.message_guard import MessageGuard

KINDS: Mapping[str, Any] = {'map': OccupancyGridMsg, 'trajectory': Path, 'graph': MarkerArray}


class HeardMap:
    """Keeps the last message of each topic of KINDS; only that one is ever looked into."""

    def __init__(self) -> None:
        self.newest: dict[str, bytes] = {}
        self.path = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))
        self.grid: OccupancyGrid | None = None
        self.keyframes, self.closures = np.zeros((0, 3)), np.zeros((0, 2, 2))

    def take(self, topic: str, data: bytes) -> None:
        """A serialized message."""
        self.newest[topic] = data

    def read(self, guard: MessageGuard) -> None:
        """Look into the newest messages; without one that can be read, its part stays empty."""
        use: dict[str, Callable[[Any], None]] = {
            'map': self.use_grid, 'trajectory': self.use_path, 'graph': self.use_graph,
        }  # fmt: skip

        def read_one(topic: str) -> None:
            use[topic](deserialize_message(self.newest[topic], KINDS[topic]))

        for topic in self.newest:
            guard.pass_on(topic, partial(read_one, topic))

    def use_grid(self, msg: Any) -> None:
        """The map."""
        self.grid = decode.occupancy_grid(msg, 'map')

    def use_path(self, msg: Any) -> None:
        """The optimised trajectory."""
        stamps = [decode.stamp(p, 'trajectory') for p in msg.poses]
        poses = [decode.planar_pose(p.pose, 'trajectory') for p in msg.poses]
        self.path = Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 3))

    def use_graph(self, msg: Any) -> None:
        """The keyframes and closures."""
        for marker in msg.markers:
            points = np.array([[p.x, p.y] for p in marker.points]).reshape(-1, 2)
            if marker.ns == 'keyframes':
                self.keyframes = np.column_stack([points, np.zeros(len(points))])
            elif marker.ns == 'closure':
                self.closures = points.reshape(-1, 2, 2)
