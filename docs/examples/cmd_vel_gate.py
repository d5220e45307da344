# SPDX-License-Identifier: Apache-2.0
"""A gate before the drives: the robot stops where the localization is LOST or says nothing.

It is the last link before the drives, which listen to nothing but ``cmd_vel_checked``::

    python3 docs/examples/cmd_vel_gate.py --ros-args -r health:=/front_end/health \\
        -r cmd_vel_in:=cmd_vel -r cmd_vel:=cmd_vel_checked
"""

from __future__ import annotations

import sys
import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

SILENT = 0.5  # [s] without a word on the health, after which the robot stops
LOST = 2


class CmdVelGate(Node):
    """Passes ``cmd_vel_in`` on to ``cmd_vel`` as long as the health is OK or DEGRADED."""

    def __init__(self, **options: Any) -> None:
        super().__init__('cmd_vel_gate', **options)
        self._heard = float('-inf')
        self._is_lost = True  # until somebody says otherwise
        self._publisher = self.create_publisher(Twist, 'cmd_vel', 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(DiagnosticStatus, 'health', self.on_health, latched)
        self.create_subscription(Twist, 'cmd_vel_in', self.on_command, 10)
        self.create_timer(0.05, self.watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def is_open(self) -> bool:
        """Whether the robot may drive."""
        return not self._is_lost and time.monotonic() - self._heard < SILENT

    def on_health(self, msg: DiagnosticStatus) -> None:
        """The newest health; where it closes the gate, the robot is stopped at once."""
        self._heard = time.monotonic()
        level = msg.level[0] if isinstance(msg.level, bytes) else int(msg.level)
        self._is_lost = level >= LOST
        self.watch()

    def on_command(self, msg: Twist) -> None:
        """A command of the controller."""
        self._publisher.publish(msg if self.is_open() else Twist())

    def watch(self) -> None:
        """Stop the robot again and again while the gate is closed."""
        if not self.is_open():
            self._publisher.publish(Twist())
        topic = self._publisher.topic_name
        if self.count_publishers(topic) > 1:
            text = f'another node publishes on {topic}: the gate cannot stop the robot'
            self.get_logger().warning(text, throttle_duration_sec=10.0)


def main() -> int:
    """Run the node."""
    rclpy.init()
    node = CmdVelGate()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
