# SPDX-License-Identifier: Apache-2.0
"""A message that cannot be used costs itself, is counted, and is in the log once."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import Pose, PoseArray
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import LaserScan

from rlml_slam.errors import InputError
from rlml_slam.ros.message_guard import (
    MAX_LOGGED,
    SMALL,
    Listener,
    MessageGuard,
    guard_of,
    waiting,
)


class Said:
    """Stands in for a logger."""

    def __init__(self):
        self.warnings, self.errors = [], []
        self.warning, self.error = self.warnings.append, self.errors.append


@pytest.fixture
def node():
    said = Said()
    subscription = SimpleNamespace(topic_name='/scan')
    return SimpleNamespace(
        get_logger=lambda: said, create_subscription=lambda *_, **__: subscription
    )


def listener(node, use, kind=LaserScan, largest=SMALL):
    return Listener(node, kind, 'scan', use, QoSProfile(depth=5), largest)


def refuse(_):
    raise InputError('scan: it is empty')


def test_message_is_given_to_its_use(node):
    used = []
    listener(node, used.append).receive(serialize_message(LaserScan(angle_min=0.5)))
    assert used[0].angle_min == 0.5
    assert guard_of(node).figures() == {}


def test_error_that_nobody_expected_is_in_the_log_however_many_refusals_are(node):
    def fail(_):
        raise ZeroDivisionError

    guard = guard_of(node)
    for k in range(3 * MAX_LOGGED):
        guard.refuse(f'topic {chr(65 + k)}', 'nonsense')
    said = node.get_logger()
    assert (len(said.warnings), said.errors) == (MAX_LOGGED, [])
    listener(node, fail).accept(LaserScan())
    assert len(said.errors) == 1
    assert 'ZeroDivisionError' in said.errors[0]
    for k in range(3 * MAX_LOGGED):
        guard.report(f'topic {chr(65 + k)}', ZeroDivisionError())
    assert len(said.errors) == MAX_LOGGED


def test_large_message_is_refused_before_anything_is_made_of_it(node, monkeypatch):
    used = []
    data = serialize_message(PoseArray(poses=[Pose()] * 20_000))
    heard = listener(node, used.append, PoseArray)
    monkeypatch.setattr('rclpy.serialization.deserialize_message', lambda *a: used.append(a))
    for _ in range(100):
        heard.receive(data)
    assert used == []
    assert guard_of(node).refused == {'scan': 100}
    assert 'more than 65536 of a PoseArray' in guard_of(node).last


@pytest.mark.parametrize('data', [b'', b'\0', b'\0\1\0\0' + b'\xff' * 50, b'\0\1\0\0'])
def test_bytes_that_are_no_message_are_counted(node, data):
    used = []
    listener(node, used.append).receive(data)
    assert used == []
    assert 'that are no LaserScan' in guard_of(node).figures()['last refused message']


def test_reason_is_in_the_log_once_whatever_numbers_it_has(node):
    guard = guard_of(node)
    for k in range(10):
        guard.refuse('scan', f'scan: {k} beams')
    guard.refuse('odom', 'odom: 3 beams')
    assert node.get_logger().warnings == ['not used: scan: 0 beams', 'not used: odom: 3 beams']
    assert guard.figures()['refused on scan'] == 10


def test_log_has_an_end(node):
    guard = guard_of(node)
    for k in range(1000):
        guard.refuse('scan', 'x' * k)
    assert len(node.get_logger().warnings) == MAX_LOGGED
    assert guard.refused['scan'] == 1000


def test_bug_costs_the_message_that_it_came_from_and_is_reported(node):
    def use(_):
        raise IndexError('out of range')

    heard = listener(node, use)
    for _ in range(3):
        heard.accept(LaserScan())
    (text,) = node.get_logger().errors
    assert 'IndexError: out of range; please report this:\nTraceback' in text
    assert guard_of(node).refused['scan'] == 3


def test_signal_passes_the_guard():
    guard = MessageGuard(Said())

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        guard.pass_on('scan', interrupted)


def test_what_the_ends_say_to_each_other_is_not_recorded(node):
    taken = []
    node.tap = lambda topic, kind, data: taken.append(topic)
    node.create_subscription = lambda kind, topic, *_, **__: SimpleNamespace(
        topic_name=f'/rlml/{topic}'
    )
    for topic in ('scan', 'rlml/graph_correction'):
        heard = Listener(node, LaserScan, topic, len, QoSProfile(depth=5))
        heard.receive(serialize_message(LaserScan()))
    assert taken == ['/rlml/scan']


def test_refused_message_is_counted(node):
    listener(node, refuse).accept(LaserScan())
    assert guard_of(node).refused == {'scan': 1}
    assert node.get_logger().errors == []


def test_messages_that_wait_are_taken_one_at_a_time():
    """Each is refused or used before the next one is in memory."""
    waits = [b'1', b'2', b'3']

    class Handle:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def take_message(self, _kind, _raw):
            return (waits.pop(0), None) if waits else None

    for data in waiting(SimpleNamespace(handle=Handle()), LaserScan, 2):
        assert len(waits) == 3 - int(data)
    assert waits == [b'3']
