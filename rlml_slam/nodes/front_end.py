# SPDX-License-Identifier: Apache-2.0
"""Executable ``front_end``: a pose with covariance for every scan or set of detections."""

from __future__ import annotations

import dataclasses
import sys
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from rlml_slam import se2, warm_up
from rlml_slam.params import Parameters
from rlml_slam.rlml.front_end import FrontEnd
from rlml_slam.ros import convert
from rlml_slam.ros.answers import FramePublisher
from rlml_slam.ros.associated import read_reflector_map
from rlml_slam.ros.beliefs import read_belief
from rlml_slam.ros.declare import declare
from rlml_slam.ros.feed import STREAMS
from rlml_slam.ros.health import HealthPublisher
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import LATCHED, RELIABLE, Sensors, checked
from rlml_slam.se2 import Array
from rlml_slam.types import Frame, Observation, Reflectors

RECENT = 1000  # frames that an initialpose may be of: the search for it takes its time


class FrontEndNode(Node):
    """Drives a FrontEnd with the robot's sensors; all stamps are those of the input."""

    def __init__(self, **options: Any) -> None:
        super().__init__('front_end', **options)
        self.params: Parameters = declare(self)
        self.front_end = FrontEnd(self.params)
        warm_up.compile_loaded()
        self.answers = FramePublisher(self, self.params.node)
        self.sensors = Sensors(self, self.params, STREAMS, self.process, self.restart)
        self.health = HealthPublisher(self, self.sensors)
        self.last: Frame | None = None
        pose = PoseWithCovarianceStamped
        self.create_subscription(pose, 'initialpose', checked(self, self.start_at), RELIABLE)
        self.create_subscription(pose, 'correction', checked(self, self.correct), LATCHED)
        self.create_subscription(PointCloud2, 'belief', checked(self, self.believe), RELIABLE)
        self.create_subscription(
            PointCloud2, 'localization_map', checked(self, self.use_map), LATCHED
        )
        self._map: Reflectors | None = None
        self._recent: deque[tuple[int, Array]] = deque(maxlen=RECENT)

    def process(self, observation: Observation) -> None:
        """One observation: estimate and publish."""
        self.last = self.front_end.process(observation)
        self._recent.append((self.last.stamp, self.last.T_local_base))
        self.answers.publish(self.last)
        self.health.update(self.last)

    def start_at(self, msg: PoseWithCovarianceStamped) -> None:
        """Begin anew at a pose of the map; one with the stamp of a frame is of that moment."""
        start = convert.pose_estimate(msg, 'initialpose')
        pose = start.pose
        for stamp, T_local_base in self._recent:
            if stamp == start.stamp:
                moved = se2.between(T_local_base, self.front_end.state.pose)
                pose = se2.compose(pose, moved)
        self._begin(pose, start.cov)
        self.get_logger().info(f'begins at {np.round(pose, 3).tolist()}')

    def restart(self) -> None:
        """Forget everything: the clock jumped back."""
        self._begin(np.array(self.params.node.map_start_pose), np.zeros((3, 3)))

    def use_map(self, msg: PointCloud2) -> None:
        """Localise in the map of the back end from where the robot is; without fields, map."""
        self._map = read_reflector_map(msg, 'localization_map') if msg.fields else None
        mode = 'mapping' if self._map is None else 'localization'
        node = dataclasses.replace(self.params.node, mode=mode)
        self.front_end = FrontEnd(dataclasses.replace(self.params, node=node))
        if self.last is None:
            self.restart()
        else:
            self._begin(self.last.T_map_base, self.last.cov_map)
        known = '' if self._map is None else f' in a map of {len(self._map)} reflectors'
        self.get_logger().info(f'mode is {mode}{known}')

    def _begin(self, pose: Array, cov: Array) -> None:
        self.front_end.reset(pose, cov)
        if self._map is not None:
            self.front_end.use_map(self._map)
        self._recent.clear()
        self.answers.begin_session()

    def believe(self, msg: PointCloud2) -> None:
        """Go on from the back end's graph where it contradicts this end's pose of now."""
        said = read_belief(msg)
        if said.session == self.answers.session:
            self.front_end.correct(said.T_map_local)
            fresh = said.stamp == self.front_end.newest
            if fresh and self.front_end.contradicts(said.belief):
                self.front_end.adopt(said.belief)

    def correct(self, msg: PoseWithCovarianceStamped) -> None:
        """Take over T_map_local from the back end."""
        self.front_end.correct(convert.pose_estimate(msg, 'correction').pose)


def main() -> int:
    """Run the node."""
    return run(FrontEndNode)


if __name__ == '__main__':
    sys.exit(main())
