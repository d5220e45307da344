# SPDX-License-Identifier: Apache-2.0
"""The publishers of a bag that is played."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from rclpy.qos import DurabilityPolicy

from rlml_slam.ros.bags.playback import Playback


def test_of_latched_topics_only_the_newest_messages_are_kept():
    made = {}
    node = SimpleNamespace(create_publisher=lambda kind, topic, qos: made.setdefault(topic, qos))
    names = ('/scan', '/map', '/tf_static', '/robot/tf_static')
    kind = 'sensor_msgs/msg/LaserScan'  # any
    topics = {n: SimpleNamespace(name=n, msgtype=kind, count=1) for n in names}
    Playback(node, SimpleNamespace(topics=topics, is_latched=lambda topic: topic != '/scan'))
    assert [made[n].depth for n in names] == [1000, 10, 100, 100]
    latched = {n for n in names if made[n].durability == DurabilityPolicy.TRANSIENT_LOCAL}
    assert latched == {*names[1:]}
