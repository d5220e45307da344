# SPDX-License-Identifier: Apache-2.0
"""What a robot's topics say, by messages that are given directly."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.cli.support.robot_setup import RobotSetup
from rlml_slam.params import Parameters
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.types import Scan

SECOND = 1_000_000_000
NOW = 1_700_000_000 * SECOND


def scan(sec, nanosec):
    ranges, none = np.ones(10, np.float32), np.zeros(0, np.float32)
    s = Scan(NOW, 'laser', 0.0, 0.1, 0.0, 0.1, 30.0, ranges, none)
    msg = encode.laser_scan(make_bag, s)
    msg.header.stamp = make_bag('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return msg


@pytest.mark.parametrize(('sec', 'nanosec'), [(0, 0), (5, SECOND)])
def test_stamp_that_no_clock_has_is_named_and_is_no_clock_that_is_off(sec, nanosec):
    setup = RobotSetup(Parameters())
    for k in range(5):
        setup.hear('scan', scan(sec, nanosec), 0.1 * k, NOW + k * SECOND // 10)
    texts = [f.text for f in setup.findings()]
    assert any(t.startswith('scan: scan: header.stamp') for t in texts)
    assert not any('the clock of this machine' in t for t in texts)
