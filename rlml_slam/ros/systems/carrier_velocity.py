# SPDX-License-Identifier: Apache-2.0
"""The carrier's announced velocity of a live system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rlml_slam.deformable.window import CarrierVelocity
from rlml_slam.params import Node
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.message_guard import checked, guard_of
from rlml_slam.ros.sensors import DEPTH, REFUSED, SENSOR
from rlml_slam.ros.systems.deformable_messages import read_velocity


class VelocityInput:
    """Subscribes to ``carrier_velocity`` and hands each message to ``announce``.

    Call ``drain`` before an observation is processed: after a pause, the detections would
    overtake the velocities that lie in the queue beside theirs.
    """

    def __init__(
        self, node: Any, params: Node, announce: Callable[[int, CarrierVelocity, bool], None]
    ) -> None:
        self._guard, topic = guard_of(node), 'carrier_velocity'
        self.receive = checked(node, topic, lambda msg: announce(*read_velocity(msg, params)))
        self._subscription = node.create_subscription(
            rclpy_class('geometry_msgs/msg/TwistStamped'), topic, self.receive,
            SENSOR,
        )  # fmt: skip

    def drain(self) -> None:
        """Everything that has arrived."""
        subscription = self._subscription
        with subscription.handle:
            for _ in range(DEPTH):
                taken = self._guard.pass_on(
                    'carrier_velocity',
                    lambda: subscription.handle.take_message(
                        subscription.msg_type, subscription.raw
                    ),
                    REFUSED,
                )
                if taken is None:
                    return
                if taken is not REFUSED:
                    self.receive(taken[0])
