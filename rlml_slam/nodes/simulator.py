# SPDX-License-Identifier: Apache-2.0
"""Node ``simulator``: a robot drives through a synthetic world, and time is what it says."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from rlml_slam.params import SimulatorParameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.declare import declare
from rlml_slam.ros.kernels import prepare
from rlml_slam.ros.message_guard import Listener
from rlml_slam.ros.playback_clock import PlaybackClock
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import RELIABLE
from rlml_slam.ros.systems.simulator_messages import SimulatedTopics
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START, STEP, Simulation
from rlml_slam.simulation.world_file import load_world

LINGER = 0.5  # [s] between the last message and the end of the process
BATCH = 20  # steps at most in one tick, so that a rate beyond reach does not shut out the rest


class SimulatorNode(Node):
    """Steps the simulation along the wall clock and publishes what it says."""

    def __init__(self, wall: Callable[[], float] = time.monotonic, **options: Any) -> None:
        super().__init__('simulator', **options)
        self.parameters = declare(self, SimulatorParameters)
        n = self.parameters.node
        self.simulation = Simulation(load_world(n.world), self.parameters)
        self._topics = SimulatedTopics(self, self.simulation)
        self._wall = wall
        self._pace: PlaybackClock | None = None
        self._finished: float | None = None
        if n.drive == 'cmd_vel':
            Listener(self, Twist, 'cmd_vel', self.on_cmd_vel, RELIABLE)
        prepare(self)
        first = f'waits for {n.wait_for_subscribers} subscribers of scan'
        self.get_logger().info(f'world {n.world}, rate {n.rate:g}: {first}')
        # steady timers: with use_sim_time, a ROS timer would wait for this node's own clock
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.005, self.tick, clock=steady)
        self.create_timer(
            1.0, lambda: self._topics.publish_clock(self.simulation.time), clock=steady
        )

    def on_cmd_vel(self, msg: Any) -> None:
        """Drive with the commanded velocity."""
        self.simulation.command(*decode.twist(msg))

    def tick(self) -> None:
        """Bring the simulation up to the wall clock; raises SystemExit when all is done."""
        n, now = self.parameters.node, self._wall()
        if self._pace is None:
            self._topics.publish_time(START)
            if not self._topics.is_heard('scan', n.wait_for_subscribers, now):
                return
            self._pace = PlaybackClock(n.rate, now)
        for _ in range(BATCH):
            if self.simulation.done:
                self._finish(now)
                return
            stalls = self._pace.stalls
            if not self._pace.is_due((self.simulation.time + STEP - START) / SECOND, now):
                return
            if self._pace.stalls > stalls:
                self.get_logger().warning('cannot keep up with the rate', once=True)
            events = self.simulation.step()
            self._topics.publish_time(self.simulation.time)
            self._topics.publish(events)

    def _finish(self, now: float) -> None:
        if self._finished is None:
            self._topics.publish(self.simulation.rest())
            self._topics.publish_clock(self.simulation.time)
            self._finished = now
            seconds = (self.simulation.time - START) / SECOND
            self.get_logger().info(f'the drive is done after {seconds:.1f} s')
        if self.parameters.node.exit_at_end and now - self._finished >= LINGER:
            raise SystemExit(0)


def main() -> int:
    """Run the node until the drive is done or a signal comes; the exit code."""
    return run(SimulatorNode)


if __name__ == '__main__':
    sys.exit(main())
