# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag as publishers, and its messages as bytes that go out as they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile

from rlml_slam.errors import BagError
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs.message_types import rclpy_class

DEPTH = 1000  # a subscriber that pauses gets all the same what it missed
# of what the player keeps for late subscribers: maps are large; several nodes publish /tf_static
LATCHED, STATIC = 10, 100


class Playback:
    """Publishers for every topic of a bag whose type is installed; the others are counted.

    They are reliable, which serves every subscription, and transient local where the recording
    was; ``/clock`` is left out, because the player has its own.
    """

    def __init__(self, node: Any, bag: BagReader) -> None:
        self._bag = bag
        self.unknown: Counter[str] = Counter()
        self._publishers: dict[str, Any] = {}
        for topic in bag.topics.values():
            kind = rclpy_class(topic.msgtype) if topic.msgtype else None
            if kind is None:
                self.unknown[f'{topic.name} ({topic.msgtype or "of several types"})'] = topic.count
            elif topic.name != '/clock':
                qos = QoSProfile(depth=DEPTH)
                if bag.is_latched(topic.name):
                    qos.depth = STATIC if topic.name.endswith('tf_static') else LATCHED
                    qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
                self._publishers[topic.name] = node.create_publisher(kind, topic.name, qos)
        if not self._publishers:
            raise BagError(f'{bag.path}: no topic of it has an installed type')

    def listeners(self, topic: str = '') -> int:
        """The number of subscriptions that a topic has; without one, the largest of all topics.

        Raises BagError if nothing is published on the topic.
        """
        topic = topic and '/' + topic.lstrip('/')
        if topic and topic not in self._publishers:
            raise BagError(f'{self._bag.path}: no topic {topic} of an installed type')
        counted = [self._publishers[topic]] if topic else self._publishers.values()
        return max(p.get_subscription_count() for p in counted)

    def messages(self) -> Iterator[tuple[int, str, bytes]]:
        """(log time [ns], topic, serialized message) in order."""
        return self._bag.serialized(self._publishers.keys())

    def publish(self, topic: str, data: bytes) -> None:
        """Send one message."""
        self._publishers[topic].publish(data)

    def drain(self, seconds: float) -> None:
        """Wait until the reliable subscriptions have everything, but not longer."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=seconds))
