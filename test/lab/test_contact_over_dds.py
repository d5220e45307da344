# SPDX-License-Identifier: Apache-2.0
"""What the study of contact sends over DDS, and how fast."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='messages over DDS need rclpy')

from rlml_lab.contact.over_dds import _run


class Intruder:
    """Counts what it sends, and what was received before."""

    def __init__(self):
        self.poses, self.sent, self.rate, self.received = {1: None}, 0, 0.0, [0]

    def send(self):
        self.sent += 1
        self.received.append(0)


def test_poses_are_received_between_messages_where_the_machine_is_too_slow_for_the_rate():
    intruder = Intruder()

    def spin_once(timeout_sec):
        intruder.received[-1] += 1

    children = SimpleNamespace(check=lambda *names: None, usage=lambda name: None)
    _run(intruder, SimpleNamespace(spin_once=spin_once), children, 200, 1e9, 0.0)
    assert intruder.sent == 200
    assert min(intruder.received[:-1]) == 1
    assert 0.0 < intruder.rate < 1e9


def test_rate_is_not_exceeded():
    intruder = Intruder()
    children = SimpleNamespace(check=lambda *names: None, usage=lambda name: None)
    _run(intruder, SimpleNamespace(spin_once=lambda timeout_sec: None), children, 100, 1e3, 0.0)
    assert 0.0 < intruder.rate < 1.02e3
