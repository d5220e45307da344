# SPDX-License-Identifier: Apache-2.0
"""Executable ``carrier_simulator``: a robot beside a moving, deforming carrier, live."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from rlml_lab.carrier.carrier import simulate_carrier
from rlml_lab.carrier.carrier_messages import CarrierTopics
from rlml_lab.carrier.carrier_parameters import CarrierParameters
from rlml_slam.ros.declare import declare
from rlml_slam.ros.playback_clock import PlaybackClock
from rlml_slam.ros.run import run
from rlml_slam.simulation.robot import SECOND

LINGER = 0.5  # [s] between the last message and the end of the process
BATCH = 20  # steps at most in one tick, so that a rate beyond reach does not shut out the rest


class CarrierSimulatorNode(Node):
    """Publishes the steps of a simulated carrier along the wall clock."""

    def __init__(self, wall: Callable[[], float] = time.monotonic, **options: Any) -> None:
        super().__init__('carrier_simulator', **options)
        self.parameters: CarrierParameters = declare(self, CarrierParameters)
        self._steps = simulate_carrier(self.parameters.carrier, self.parameters.node.seed)
        self._step = next(self._steps)
        self._topics = CarrierTopics(self, self.parameters)
        self._wall = wall
        self._pace: PlaybackClock | None = None
        self._finished: float | None = None
        # a steady timer: with use_sim_time, a ROS timer would wait for this node's own clock
        self.create_timer(0.005, self.tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def tick(self) -> None:
        """Publish what is due; raises SystemExit when all is done."""
        n, now = self.parameters.node, self._wall()
        if self._pace is None:
            if self._topics.listeners('reflectors') < n.wait_for_subscribers:
                return
            self._pace = PlaybackClock(n.rate, now)
        for _ in range(BATCH):
            moment = self._step.stamp / SECOND
            if n.duration and moment > n.duration:
                self._finish(now)
                return
            if not self._pace.is_due(moment, now):
                return
            after = next(self._steps)
            self._topics.publish(self._step, after)
            self._step = after

    def _finish(self, now: float) -> None:
        if self._finished is None:
            self._finished = now
            duration = self.parameters.node.duration
            self.get_logger().info(f'the drive is done after {duration:.1f} s')
        if self.parameters.node.exit_at_end and now - self._finished >= LINGER:
            raise SystemExit(0)


def main() -> int:
    """Run the node until the drive is done or a signal comes; the exit code."""
    return run(CarrierSimulatorNode)


if __name__ == '__main__':
    sys.exit(main())
