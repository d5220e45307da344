# SPDX-License-Identifier: Apache-2.0
"""A drive over DDS as one MCAP file: inputs and everything that the nodes publish, as it came."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from rlml_slam.cli.support.interface import LATCHED, OUT, SENSOR, TOPICS
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs.message_types import bag_types, rclpy_class

OURS = ('front_end', 'back_end', 'simulator')
INNER = '/rlml/'  # what front end and back end say to each other
DEPTH = 1000
OTHERS = {
    '/rosout': 'rcl_interfaces/msg/Log',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}


def published() -> dict[str, tuple[str, str]]:
    """(type, quality of service) by name of all topics of the nodes of a drive."""
    out = {}
    for t in TOPICS:
        name = '/' + t.name.replace('~', t.node).lstrip('/')
        if t.direction == OUT and t.node in OURS and not name.startswith(INNER):
            package, _, kind = t.type.partition('/')
            out[name] = f'{package}/msg/{kind}', t.qos
    return out


class LiveBag:
    """Writes what comes on topics to ``writer``; types that are not installed are left out.

    ``inputs`` has the types of further topics. The topic ``sensor``, whose listeners are counted,
    is not listened to: it is given to ``take``.
    """

    def __init__(self, writer: BagWriter, inputs: Mapping[str, str], sensor: str) -> None:
        self._writer, self._sensor = writer, '/' + sensor.lstrip('/')
        self._last = 0
        known = bag_types().fielddefs
        every = {t: (kind, SENSOR) for t, kind in {**inputs, **OTHERS}.items()} | published()
        self._topics = {
            t: (kind, qos) for t, (kind, qos) in every.items()
            if kind in known and rclpy_class(kind) is not None
        }  # fmt: skip
        for topic, (kind, qos) in self._topics.items():
            writer.add_topic(topic, kind, latched=qos == LATCHED)

    def listen(self, node: Any) -> None:
        """Begin, as a part of a node."""
        for topic, (kind, qos) in self._topics.items():
            if topic == self._sensor:
                continue
            profile = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
            if qos == LATCHED:
                profile.reliability = ReliabilityPolicy.RELIABLE
                profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
            node.create_subscription(
                rclpy_class(kind), topic, partial(self._write, topic), profile, raw=True
            )

    def take(self, data: bytes) -> None:
        """A message of the sensor."""
        if self._sensor in self._topics:
            self._write(self._sensor, data)

    def _write(self, topic: str, data: bytes) -> None:
        self._last = max(time.time_ns(), self._last + 1)  # though the clock may step back
        self._writer.write_serialized(topic, data, self._last)
