# SPDX-License-Identifier: Apache-2.0
"""Executable ``bag_player``: publishes any bag with /clock at a chosen rate, and ends."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from rlml_slam.errors import BagError
from rlml_slam.params import PlayerParameters
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.bags.playback import Playback
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy
from rlml_slam.ros.declare import declare
from rlml_slam.ros.playback_clock import PlaybackClock
from rlml_slam.ros.run import run

TICK = 0.002  # [s]
BATCH = 50  # messages at most in one tick, so that signals and services get their turn
SECOND = 1_000_000_000


class BagPlayerNode(Node):
    """Publishes the messages in the order of the log, each when its log time has come."""

    def __init__(self, wall: Callable[[], float] = time.monotonic, **options: Any) -> None:
        super().__init__('bag_player', **options)
        self.parameters = declare(self, PlayerParameters).node
        if not self.parameters.bag:
            raise BagError('no bag given: -p bag:=PATH')
        self.bag = BagReader(self.parameters.bag)
        self.playback = Playback(self, self.bag)
        for topic, count in self.playback.unknown.items():
            self.get_logger().warning(f'type not installed: {topic}, {count} messages left out')
        self.playback.listeners(self.parameters.wait_for_topic)  # refused now, not while it waits
        self._messages = self.playback.messages()
        self._next = next(self._messages, None)
        self._wall = wall
        self._began = wall()
        self._pace: PlaybackClock | None = None
        self._time = self.create_publisher(Clock, '/clock', 10)
        self._tick_due = self.bag.start
        self.published = 0
        # steady: with use_sim_time, a ROS timer would wait for this node's own clock
        self.create_timer(TICK, self.tick, clock=RosClock(clock_type=ClockType.STEADY_TIME))

    def tick(self) -> None:
        """Publish what is due; raises SystemExit after the last message."""
        now = self._wall()
        if self._pace is None:
            p = self.parameters
            if self.playback.listeners(p.wait_for_topic) < p.wait_for_subscribers:
                self._began = now
                return
            if now - self._began < p.start_delay:
                return
            self._pace = PlaybackClock(self.parameters.rate, now)
        for _ in range(BATCH):
            if self._next is None:
                self._finish()
            log_time, topic, data = self._next
            moment = min(log_time, self._tick_due)
            if not self._pace.is_due((moment - self.bag.start) / SECOND, now):
                return
            if moment == self._tick_due:
                self._time.publish(encode.clock(make_rclpy, moment))
                self._tick_due += int(SECOND / self.parameters.clock_rate)
            else:
                self.playback.publish(topic, data)
                self.published += 1
                self._next = self._advance()

    def _advance(self) -> tuple[int, str, bytes] | None:
        try:
            return next(self._messages, None)
        except BagError as e:
            self.get_logger().error(f'{e}; what came before was published')
            raise SystemExit(1) from e

    def _finish(self) -> NoReturn:
        self.playback.drain(2.0)
        self.get_logger().info(f'{self.published} messages published')
        raise SystemExit(0)


def main() -> int:
    """Run the node until the bag ends or a signal comes; the exit code."""
    return run(BagPlayerNode)


if __name__ == '__main__':
    sys.exit(main())
