# SPDX-License-Identifier: Apache-2.0
"""What the study of contact sends over DDS, and how fast."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='messages over DDS need rclpy')

import numpy as np

from rlml_lab.contact import over_dds
from rlml_lab.contact.over_dds import MOST, figures
from rlml_lab.main import main

CHILDREN = SimpleNamespace(check=lambda *names: None, usage=lambda name: None)
SECOND = 1_000_000_000


class Intruder:
    """Counts what it sends, and what it has heard before each of these; so many come for each."""

    def __init__(self, come=1):
        self.poses, self.sent, self.rate, self.heard = {1: None}, 0, 0.0, 0
        self.waiting, self.come, self.heard_before = 0, come, []

    def send(self):
        self.sent += 1
        self.heard_before.append(self.heard)
        self.waiting += self.come

    def spin_once(self, timeout_sec):
        if self.waiting:
            self.waiting -= 1
            self.heard += 1


def run(intruder, messages, rate, seconds=0.0):
    over_dds._run(intruder, intruder, CHILDREN, messages, rate, seconds)
    return intruder


def test_all_that_comes_is_received_where_the_machine_is_too_slow_for_the_rate():
    intruder = run(Intruder(come=5), 200, 1e9)
    assert intruder.sent == 200
    assert intruder.heard_before == [5 * k for k in range(200)]
    assert 0.0 < intruder.rate < 1e9


def test_what_comes_without_end_holds_up_nothing():
    intruder = run(Intruder(come=10 * MOST), 200, 1e9)
    assert intruder.heard_before[-1] <= 200 * MOST


def test_rate_is_not_exceeded():
    intruder = run(Intruder(), 100, 1e3)
    assert intruder.sent == 100
    assert 0.0 < intruder.rate < 1.02e3


def drive(silent_after):
    """A drive of 60 s with a pose for each tenth of a second until then."""
    true = {SECOND + k * SECOND // 10: np.array([0.1 * k, 0.0, 0.0]) for k in range(600)}
    poses = {t: p for t, p in true.items() if t <= SECOND * (1 + silent_after)}
    return SimpleNamespace(true=true, poses=poses)


@pytest.mark.parametrize(('silent_after', 'rate'), [(60.0, 10.0), (3.0, 0.5)])
def test_node_that_falls_silent_lowers_the_rate_of_poses(silent_after, rate):
    found, error = figures(drive(silent_after))
    assert found == pytest.approx(rate, rel=0.01)
    assert error < 1e-9


@pytest.mark.parametrize('rate', ['0', '-1'])
def test_rate_is_above_zero(rate, capsys):
    assert main(['study', 'contact', '--messages', '0', '--rate', rate]) == 1
    assert 'must be above 0' in capsys.readouterr().err
