# SPDX-License-Identifier: Apache-2.0
"""Executable ``back_end``: the graph of keyframes and reflectors, map to odom, the map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from rlml_slam.ros.back_end.map_services import MapServices
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.back_end.user_requests import UserRequests
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.frame_messages import POINT, FrameAssembler, read_points, read_record
from rlml_slam.ros.codecs.reflector_clouds import ASSOCIATED, read_associated
from rlml_slam.ros.declare import pace
from rlml_slam.ros.diagnostics import HealthPublisher
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.message_guard import SMALL, Listener
from rlml_slam.ros.run import run
from rlml_slam.slam.conversation import FrontEndCommand, SessionFrame

Take = Callable[[FrontEndCommand], None]
DEPTH = 200  # of the front end's answers: none may be lost while the map is drawn
SETTLE_PERIOD = 0.1  # [s] between two looks whether the input has fallen silent


class BackEndNode(ManagedNode):
    """Gives frames to the mapper, which come by messages or, in the same process, by ``take``."""

    def __init__(self, command: Take | None = None, **options: Any) -> None:
        self._command = command
        super().__init__('back_end', **options)

    def build(self) -> None:
        """The mapper with its topics and services; a saved map is read and checked."""
        n, command = self.params.node, self._command
        self.mapper = Mapper(self, self.params, command)
        self.exits.callback(self.mapper.close)
        path = self.checks['map_file_name'] = self.mapper.archive.folder.path
        self.get_logger().info(f'{n.mode}; the map is {path(n.map_file_name)}')
        self.requests = UserRequests(self.mapper, self.params, self.get_logger())
        self.join = FrameAssembler()
        self.health = HealthPublisher(self, None, self.figures, self.mapper.problems)
        self.map_services = MapServices(self, self.params, self.mapper, self.requests)
        if command is None:
            self._subscribe()
        timer = self.every(n.transform_publish_period or 0.1, self.mapper.send_transform)
        self.checks['transform_publish_period'] = pace(timer)
        self.every(SETTLE_PERIOD, self.mapper.settle)

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
        if not self.is_active:
            return
        self.mapper.add(record)
        self.health.update(record.frame)

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        own = {'frames without their points or detections': self.join.incomplete}
        return {**self.mapper.figures(), **self.map_services.figures(), **own}

    def begin(self) -> None:
        """Announce the mode and the map; later, draw what came in before the pause."""
        self.requests.begin()

    def rest(self) -> None:
        """Write down what the journal has not yet."""
        self.mapper.worker.submit(self.mapper.journal.flush)


def main() -> int:
    """Run the node."""
    return run(BackEndNode)


if __name__ == '__main__':
    sys.exit(main())
