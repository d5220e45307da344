# SPDX-License-Identifier: Apache-2.0
"""The carrier's announced velocity of a live system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rlml_slam.deformable.window import CarrierVelocity
from rlml_slam.params import Node
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.message_guard import Listener
from rlml_slam.ros.sensors import SENSOR
from rlml_slam.ros.systems.deformable_messages import read_velocity


class VelocityInput:
    """Subscribes to ``carrier_velocity`` and hands each message to ``announce``.

    Call ``drain`` before an observation is processed: after a pause, the detections would
    overtake the velocities that lie in the queue beside theirs.
    """

    def __init__(
        self, node: Any, params: Node, announce: Callable[[int, CarrierVelocity, bool], None]
    ) -> None:
        kind, topic = rclpy_class('geometry_msgs/msg/TwistStamped'), 'carrier_velocity'
        self._listener = Listener(
            node, kind, topic, lambda msg: announce(*read_velocity(msg, params)), SENSOR
        )
        self.receive = self._listener.accept

    def drain(self) -> None:
        """Everything that has arrived."""
        for msg in self._listener.drained():
            self.receive(msg)
