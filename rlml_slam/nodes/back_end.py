# SPDX-License-Identifier: Apache-2.0
"""Executable ``back_end``: the graph of keyframes and reflectors, map to odom, the map."""

from __future__ import annotations

import sys
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from rlml_slam import warm_up
from rlml_slam.params import Parameters
from rlml_slam.ros import convert
from rlml_slam.ros.associated import read_associated
from rlml_slam.ros.declare import declare
from rlml_slam.ros.health import HealthPublisher
from rlml_slam.ros.join import FrameJoin, follower, restarted
from rlml_slam.ros.mapper import Mapper
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import Sensors, checked
from rlml_slam.ros.services import MapServices
from rlml_slam.types import Frame, Observation

STREAMS = ('scan', 'odom', 'imu')
DEPTH = 200  # of the front end's answers: none may be lost while the map is drawn


class BackEndNode(Node):
    """Joins the sensors and the front end by stamp and hands the frames to the mapper."""

    def __init__(self, **options: Any) -> None:
        super().__init__('back_end', **options)
        self.params: Parameters = declare(self)
        self.mapper = Mapper(self, self.params)
        warm_up.compile_loaded()
        self.join = FrameJoin(self.params)
        self.sensors = Sensors(self, follower(self.params), STREAMS, self.observe, self.restart)
        self.health = HealthPublisher(self, self.sensors, self.figures)
        self.services_of_map = MapServices(self, self.params, self.mapper, self.join)
        self._last: Frame | None = None
        self.create_subscription(
            PointCloud2, 'reflectors/associated', checked(self, self.on_associated), DEPTH
        )
        self.create_subscription(Odometry, 'odometry/filtered', checked(self, self.on_pose), DEPTH)
        self.create_timer(
            self.params.node.transform_publish_period,
            lambda: self.mapper.send_transform(self.sensors.sequencer.buffer.newest),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def on_associated(self, msg: PointCloud2) -> None:
        """Detections with the front end's landmarks, in the base frame."""
        associated = read_associated(msg)
        self.join.add_associated(associated)
        self.sensors.add_detections(associated.detections)

    def on_pose(self, msg: Odometry) -> None:
        """The front end's pose in its local frame."""
        self.take(self.join.add_pose(convert.pose_estimate(msg, 'odometry/filtered')))

    def observe(self, observation: Observation) -> None:
        """What the sensors said at one stamp."""
        self.take(self.join.add_observation(observation))

    def take(self, frames: list[Frame]) -> None:
        """Hand whole frames to the mapper."""
        for frame in frames:
            if self._last is not None and restarted(self._last, frame):
                self.get_logger().warning('the front end began anew, and so does the map')
                self.mapper.restart()
            self._last = frame
            self.mapper.add(frame)
            self.health.update(frame)

    def restart(self) -> None:
        """Forget everything: the clock jumped back."""
        self.join = FrameJoin(self.params)
        self._last = None
        self.mapper.restart()

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        graph = self.mapper.back_end.graph
        return {
            'keyframes': len(graph.poses),
            'edges': len(graph.edges),
            'frames waiting for the worker': self.mapper.worker.backlog,
            'observations without an answer of the front end': self.join.unanswered,
        }

    def destroy_node(self) -> None:
        """Finish the running job first."""
        self.mapper.worker.close()
        super().destroy_node()


def main() -> int:
    """Run the node."""
    return run(BackEndNode)


if __name__ == '__main__':
    sys.exit(main())
