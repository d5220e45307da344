# SPDX-License-Identifier: Apache-2.0
"""Executable ``front_end``: a pose with covariance for every scan or set of detections."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rlml_slam.ros.diagnostics import HealthPublisher, map_id
from rlml_slam.ros.front_end.black_box import BlackBox
from rlml_slam.ros.front_end.frame_publisher import FramePublisher
from rlml_slam.ros.front_end.front_end_control import FrontEndControl
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.run import run
from rlml_slam.ros.sensor_input import STREAMS
from rlml_slam.ros.sensors import Sensors
from rlml_slam.slam.conversation import FrontEndCommand, LocalizeIn, SessionFrame
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Frame, Observation


class FrontEndNode(ManagedNode):
    """Drives a FrontEnd with the robot's sensors; all stamps are those of the input."""

    def __init__(self, has_back_end: bool = False, **options: Any) -> None:
        self.take: Callable[[SessionFrame], None] | None = None  # a back end in the same process
        self._has_back_end = has_back_end
        self.back_end_problems: Callable[[], tuple[str, ...]] = tuple
        self._map: LocalizeIn | None = None
        self._obey: Callable[[FrontEndCommand], None] = lambda _: None  # while there is a control
        super().__init__('front_end', **options)

    def build(self) -> None:
        """The estimator with its topics."""
        self.black_box = BlackBox(self, self.params, lambda: map_id(self.control.session.map))
        self.tap = self.black_box.tap
        self.answers = FramePublisher(self, self.params.node)
        began, has_back_end = self.answers.begin_session, self._has_back_end
        self.control = FrontEndControl(self, self.params, began, self.publish, has_back_end)
        self.sensors = Sensors(self, self.params, STREAMS, self.process, self.control.restart)
        self.sensors.arrange = self.black_box.arrange
        self.health = HealthPublisher(self, self.sensors, self.figures, self.problems)
        self.exits.callback(setattr, self, '_obey', self._obey)
        self._obey = self.control.command  # first: the map of another thread may come just now
        if self._map is not None:
            self.control.command(self._map)

    def command(self, command: FrontEndCommand) -> None:
        """A command of the back end in this process, from any thread."""
        if isinstance(command, LocalizeIn):
            self._map = command  # for a front end that is configured again
        self._obey(command)

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        return {'map id': map_id(self.control.session.map)}

    def problems(self) -> tuple[str, ...]:
        """What is wrong around the estimate."""
        around = self.answers, self.control, self.sensors, self.black_box
        return sum((part.problems() for part in around), self.back_end_problems())

    @property
    def front_end(self) -> FrontEnd:
        """The estimator as it is now."""
        return self.control.session.front_end

    @property
    def last(self) -> Frame | None:
        """The newest frame, None before the first."""
        return self.control.session.last

    def process(self, observation: Observation) -> None:
        """One observation: estimate and publish."""
        self.control.carry_out()
        self.publish(self.control.session.process(observation))
        self.front_end.settle()

    def publish(self, record: SessionFrame) -> None:
        """Give a frame to all who wait for it."""
        record = replace(record, frame=self.answers.with_odometry(record.frame))
        self.answers.publish(record)
        if self.take is not None:
            self.take(record)
        self.health.update(record.frame)
        self.black_box.follow(record.frame)
        self.sensors.synchronizer.follow(record.frame)


def main() -> int:
    """Run the node."""
    return run(FrontEndNode)


if __name__ == '__main__':
    sys.exit(main())
