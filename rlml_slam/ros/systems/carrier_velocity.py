# SPDX-License-Identifier: Apache-2.0
"""The carrier's announced velocity of a live system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rlml_slam.deformable.window import CarrierVelocity
from rlml_slam.params import Node
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.sensors import DEPTH, SENSOR, checked
from rlml_slam.ros.systems.deformable_messages import read_velocity


class VelocityInput:
    """Subscribes to ``carrier_velocity`` and hands each message to ``announce``.

    Call ``drain`` before an observation is processed: after a pause, the detections would
    overtake the velocities that lie in the queue beside theirs.
    """

    def __init__(
        self, node: Any, params: Node, announce: Callable[[int, CarrierVelocity, bool], None]
    ) -> None:
        self.receive = checked(node, lambda msg: announce(*read_velocity(msg, params)))
        self._subscription = node.create_subscription(
            rclpy_class('geometry_msgs/msg/TwistStamped'), 'carrier_velocity', self.receive,
            SENSOR,
        )  # fmt: skip

    def drain(self) -> None:
        """Everything that has arrived."""
        subscription = self._subscription
        with subscription.handle:
            for _ in range(DEPTH):
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    return
                self.receive(taken[0])
