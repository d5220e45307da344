# SPDX-License-Identifier: Apache-2.0
"""Executable ``back_end``: the graph of keyframes and reflectors, map to odom, the map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from rlml_slam import warm_up
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.back_end_figures import figures
from rlml_slam.ros.back_end.map_services import MapServices
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.back_end.user_requests import UserRequests
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.frame_messages import POINT, FrameAssembler, read_points, read_record
from rlml_slam.ros.codecs.reflector_clouds import ASSOCIATED, read_associated
from rlml_slam.ros.declare import declare
from rlml_slam.ros.diagnostics import HealthPublisher
from rlml_slam.ros.message_guard import SMALL, Listener
from rlml_slam.ros.run import run
from rlml_slam.slam.conversation import FrontEndCommand, SessionFrame

DEPTH = 200  # of the front end's answers: none may be lost while the map is drawn
SETTLE_PERIOD = 0.1  # [s] between two looks whether the input has fallen silent


class BackEndNode(Node):
    """Joins the front end's messages by stamp and gives the frames to the mapper.

    A front end in the same process gets its commands by ``command``, and gives frames to ``take``.
    """

    def __init__(
        self, command: Callable[[FrontEndCommand], None] | None = None, **options: Any
    ) -> None:
        super().__init__('back_end', **options)
        self.params: Parameters = declare(self)
        self.mapper = Mapper(self, self.params, command)
        self.requests = UserRequests(self.mapper, self.params, self.get_logger())
        warm_up.compile_loaded()
        self.join = FrameAssembler()
        self.health = HealthPublisher(self, None, self.figures, self.mapper.problems)
        self.map_services = MapServices(self, self.params, self.mapper, self.requests)
        if command is None:
            self._subscribe()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        period = self.params.node.transform_publish_period
        self.create_timer(period, self.mapper.send_transform, clock=steady)
        self.create_timer(SETTLE_PERIOD, self.mapper.settle, clock=steady)

    def _subscribe(self) -> None:
        join, n = self.join, self.params.node
        for topic, largest, add in (
            ('rlml/frames', 0, lambda m: join.add_record(read_record(m))),
            ('deskewed_points', n.max_beams * POINT.itemsize,
             lambda m: join.add_points(decode.stamp(m, 'deskewed_points'), read_points(m))),
            ('reflectors/associated', n.max_reflectors * ASSOCIATED.itemsize,
             lambda m: join.add_associated(read_associated(m))),
        ):  # fmt: skip
            use = partial(self._take_all, add)
            Listener(self, PointCloud2, topic, use, QoSProfile(depth=DEPTH), SMALL + largest)

    def _take_all(self, add: Callable[[Any], list[SessionFrame]], msg: Any) -> None:
        for record in add(msg):
            self.take(record)

    def take(self, record: SessionFrame) -> None:
        """Give a whole frame to the mapper."""
        self.mapper.add(record)
        self.health.update(record.frame)

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        return {
            **figures(self.mapper), **self.map_services.figures(),
            'frames without their points or detections': self.join.incomplete,
        }  # fmt: skip

    def destroy_node(self) -> None:
        """Finish the running jobs first."""
        self.mapper.close()
        super().destroy_node()


def main() -> int:
    """Run the node."""
    return run(BackEndNode)


if __name__ == '__main__':
    sys.exit(main())
