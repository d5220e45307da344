# SPDX-License-Identifier: Apache-2.0
"""Who asks tf2 where the robot is now gets an answer, and the pose where it scanned."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from tf2_rules import Buffer, Refused

from rlml_slam import se2
from rlml_slam.params import Node
from rlml_slam.ros.back_end import map_transform
from rlml_slam.ros.back_end.map_transform import MapTransform
from rlml_slam.types import Frame, Motion, Observation

SECOND = 1_000_000_000
MS = SECOND // 1000
MAP_ODOM, ODOM_BASE = ('map', 'odom'), ('odom', 'base_link')
NONE = np.zeros(0, dtype=np.int64)


class Robot:
    """A node with a clock, which hears its own transforms at once."""

    def __init__(self):
        self.now = 100 * SECOND
        self.buffer = Buffer()

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now))

    def publish(self, stamp, edge, T):
        self.buffer.add(stamp, edge, T)


@pytest.fixture
def robot(monkeypatch):
    robot = Robot()
    monkeypatch.setattr(
        map_transform, 'TransformPublisher', lambda node: SimpleNamespace(publish=node.publish)
    )
    return robot


def odom_pose(t):
    return np.array([0.4 * t, 2.0 * math.sin(0.3 * t), 0.5 * math.sin(0.2 * t)])


def map_pose(t):
    """Odometry drifts by 5 cm and 0.05 degrees a second."""
    return se2.compose([0.05 * t, -0.02 * t, math.radians(0.05) * t], odom_pose(t))


def frame(stamp):
    t = stamp / SECOND
    observation = Observation(stamp, Motion(np.zeros(3), np.eye(3)), odom_pose=odom_pose(t))
    T = map_pose(t)
    return Frame(stamp, observation, T, np.eye(3), T, np.eye(3), NONE, NONE)


def drive(robot, seconds, rng, **node):
    """Refusals of map to base now, every 20 ms; scans at 10 Hz come up to 0.3 s late."""
    transform = MapTransform(robot, Node(**node))
    coming, refused, asked, worst = [], 0, 0, 0.0
    start = robot.now
    for k in range(int(50 * seconds)):
        robot.now = start + k * 20 * MS
        robot.buffer.add(robot.now, ODOM_BASE, odom_pose(robot.now / SECOND))
        if k % 5 == 0:
            coming.append((robot.now + int(rng.uniform(0.1, 0.3) * SECOND), robot.now))
        while coming and coming[0][0] <= robot.now:
            _, stamp = coming.pop(0)
            transform.follow(frame(stamp))
            off = se2.between(map_pose(stamp / SECOND), robot.buffer.chain(stamp, *EDGES))
            worst = max(worst, math.hypot(off[0], off[1]))
        transform.repeat()
        if k >= 50:
            asked += 1
            try:
                robot.buffer.chain(robot.now, *EDGES)
            except Refused:
                refused += 1
    return refused, asked, worst


EDGES = (MAP_ODOM, ODOM_BASE)


def test_now_is_never_refused_and_scans_are_exact(robot):
    refused, asked, worst = drive(robot, 300.0, np.random.default_rng(1))
    assert asked > 14_000
    assert refused == 0
    assert worst < 1e-9
    assert robot.buffer.repeated == 0


def test_period_0_at_run_time_stops_it_and_another_one_starts_it(robot):
    sent, node = [], Node()
    robot.publish = lambda stamp, edge, T: sent.append(stamp)
    transform = MapTransform(robot, node)

    def drive_on(period):
        node.change('transform_publish_period', period)
        sent.clear()
        for _ in range(5):
            robot.now += 50 * MS
            transform.repeat()
        repeated = len(sent)
        robot.now += MS
        transform.follow(frame(robot.now))
        return repeated, len(sent) - repeated

    assert drive_on(0.02) == (0, 2)  # nothing was there to repeat
    assert drive_on(0.02) == (5, 2)
    assert drive_on(0.0) == (0, 0)
    assert drive_on(0.0) == (0, 0)
    assert drive_on(0.05)[1] == 2
    assert drive_on(0.05) == (5, 2)


def test_period_that_goes_to_0_and_back_makes_no_further_publisher(robot, monkeypatch):
    made = []
    monkeypatch.setattr(map_transform, 'TransformPublisher', lambda node: made.append(1) or node)
    node = Node()
    transform = MapTransform(robot, node)
    for period in (0.0, 0.02) * 3:
        node.change('transform_publish_period', period)
        robot.now += SECOND
        transform.follow(frame(robot.now))
    assert made == [1]


def test_without_tolerance_now_is_refused(robot):
    refused, asked, _ = drive(robot, 20.0, np.random.default_rng(1), transform_tolerance=0.0)
    assert refused == asked
