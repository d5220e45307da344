# SPDX-License-Identifier: Apache-2.0
"""Executable ``back_end``: the graph of keyframes and reflectors, map to odom, the map."""

from __future__ import annotations

import sys
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from rlml_slam import warm_up
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_services import MapServices
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.frame_messages import FrameAssembler, Record, read_points, read_record
from rlml_slam.ros.codecs.reflector_clouds import read_associated
from rlml_slam.ros.declare import declare
from rlml_slam.ros.diagnostics import HealthPublisher
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import checked
from rlml_slam.slam.closures.closure_table import state_counts

DEPTH = 200  # of the front end's answers: none may be lost while the map is drawn
SETTLE_PERIOD = 0.1  # [s] between two looks whether the input has fallen silent


class BackEndNode(Node):
    """Joins what the front end says by stamp and hands the frames to the mapper."""

    def __init__(self, **options: Any) -> None:
        super().__init__('back_end', **options)
        self.params: Parameters = declare(self)
        self.mapper = Mapper(self, self.params)
        warm_up.compile_loaded()
        self.join = FrameAssembler()
        self.health = HealthPublisher(self, figures=self.figures)
        self.map_services = MapServices(self, self.params, self.mapper, self.join)
        for topic, callback in (
            ('frames', self.on_frame),
            ('deskewed_points', self.on_points),
            ('reflectors/associated', self.on_associated),
        ):
            self.create_subscription(PointCloud2, topic, checked(self, callback), DEPTH)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        period = self.params.node.transform_publish_period
        self.create_timer(period, self.mapper.send_transform, clock=steady)
        self.create_timer(SETTLE_PERIOD, self.mapper.settle, clock=steady)

    def on_frame(self, msg: PointCloud2) -> None:
        """Every figure of one of the front end's frames."""
        self.take(self.join.add_record(read_record(msg)))

    def on_points(self, msg: PointCloud2) -> None:
        """The end points of its scan."""
        time = decode.stamp(msg, 'deskewed_points')
        self.take(self.join.add_points(time, read_points(msg)))

    def on_associated(self, msg: PointCloud2) -> None:
        """Its detections with their landmarks."""
        self.take(self.join.add_associated(read_associated(msg)))

    def take(self, records: list[Record]) -> None:
        """Hand whole frames to the mapper."""
        for record in records:
            self.mapper.add(record)
            self.health.update(record.frame)

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        back_end = self.mapper.back_end
        return {
            'keyframes': len(back_end.graph.poses),
            'edges': len(back_end.graph.edges),
            'closures accepted': back_end.loop_closer.tried[True],
            'closures rejected': back_end.loop_closer.tried[False],
            **state_counts(back_end.loop_closer.records),
            **self.mapper.continued,
            **({} if back_end.survey_frame is None else {'survey': back_end.survey_frame.why}),
            'constellations not searched': back_end.constellation_search.not_searched,
            'frames waiting for the worker': self.mapper.worker.backlog,
            'frames without their points or detections': self.join.incomplete,
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
