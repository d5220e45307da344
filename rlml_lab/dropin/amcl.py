# SPDX-License-Identifier: Apache-2.0
"""Another localization beside ours: it publishes what AMCL publishes.

``python -m rlml_lab.dropin.amcl`` knows the truth of ``robot.py``, and is wrong by a known circle.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry
from rclpy.node import Node

from rlml_lab.dropin.robot import LATCHED, TRUTH
from rlml_lab.dropin.tf_messages import tf_message
from rlml_slam import se2
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.run import run
from rlml_slam.simulation.robot import SECOND

TOPICS = ('map', 'map_metadata', 'amcl_pose', 'particle_cloud')
EVERY = SECOND // 10
AHEAD = SECOND  # [ns], AMCL's default
OFF, TURN = 0.05, 60.0  # [m, s]: the circle by which this AMCL is wrong


def error(stamp: int) -> se2.Array:
    """By which this AMCL is wrong at a stamp [ns]; map frame."""
    a = 2.0 * math.pi * (stamp % int(TURN * SECOND)) / (TURN * SECOND)
    return np.array([OFF * math.cos(a), OFF * math.sin(a), 0.0])


class Amcl(Node):
    """Ten times a second map to odom and ``amcl_pose``; a map, once."""

    def __init__(self) -> None:
        super().__init__('amcl')
        kind = tf_message()
        self._odom: dict[int, Any] = {}
        self._next = 0
        self._tf = self.create_publisher(kind, '/tf', 100)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 100)
        self._particles = self.create_publisher(PoseArray, 'particle_cloud', 100)
        self._map = self.create_publisher(OccupancyGrid, 'map', LATCHED)
        self._metadata = self.create_publisher(MapMetaData, 'map_metadata', LATCHED)
        grid = OccupancyGrid(data=[0])
        grid.header.frame_id = 'map'
        grid.info = MapMetaData(resolution=0.05, width=1, height=1)
        self._map.publish(grid)
        self._metadata.publish(grid.info)
        self.create_subscription(kind, '/tf', self._on_tf, 100)
        self.create_subscription(Odometry, TRUTH, self._on_truth, 100)

    def _on_tf(self, msg: Any) -> None:
        for t in msg.transforms:
            if t.header.frame_id == 'odom':
                (found,) = decode.transforms(t, '/tf')
                pose = np.array([*found.t[:2], decode.yaw(found.R, '/tf')])
                self._odom[decode.stamp(t, '/tf')] = pose
        while len(self._odom) > 100:
            del self._odom[next(iter(self._odom))]

    def _on_truth(self, msg: Odometry) -> None:
        stamp = decode.stamp(msg, TRUTH)
        T_odom_base = self._odom.get(stamp)
        if T_odom_base is None or stamp < self._next:
            return
        self._next = stamp + EVERY
        T = decode.planar_pose(msg.pose.pose, TRUTH) + error(stamp)
        T_map_odom = se2.compose(T, se2.inverse(T_odom_base))
        transform = encode.transform(make, stamp + AHEAD, ('map', 'odom'), T_map_odom)
        self._tf.publish(encode.tf_message(make, [transform]))
        pose = encode.pose_with_covariance(make, stamp, 'map', T, OFF**2 * np.eye(3))
        self._pose.publish(pose)
        self._particles.publish(PoseArray(header=pose.header, poses=[pose.pose.pose]))


if __name__ == '__main__':
    sys.exit(run(Amcl))
