# SPDX-License-Identifier: Apache-2.0
"""Sensors that hang upside down, and scans of drivers that know no farthest range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam.params import Node, Parameters
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.decode import Transform
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.sensing.deskew import project
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.types import Detections, Scan

PLACE = np.array([0.4, -0.1, 0.7])
ANGLES = np.linspace(-2.0, 2.0, 9)
FOUND = np.array([[3.0, 1.0], [-2.0, 0.5]])
SCAN = Scan(
    5, 'laser', -2.0, 0.5, 1e-3, 0.1, 30.0, np.arange(1.0, 10.0, dtype=np.float32),
    np.zeros(0, dtype=np.float32),
)  # fmt: skip
SEEN = Detections(
    5, 'laser', FOUND, np.tile([[0.04, 0.01], [0.01, 0.02]], (2, 1, 1)), np.full(2, -1),
    np.full(2, np.nan),
)  # fmt: skip


class Target:
    """Keeps what it is given."""

    def __init__(self):
        self.given, self.places = [], {}

    def set_sensor_pose(self, frame_id, T_base_sensor):
        self.places[frame_id] = T_base_sensor

    def add_scan(self, scan):
        self.given.append(scan)
        return []

    add_detections = add_scan


def upside_down():
    """R and t of the laser: half a turn about its x axis, which points to PLACE's heading."""
    c, s = np.cos(PLACE[2]), np.sin(PLACE[2])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1.0, -1.0, -1.0])
    return R, np.array([*PLACE[:2], 2.0])


def in_base(points):
    """Points (n, 2) of the laser's plane in the base frame."""
    R, t = upside_down()
    return (np.column_stack([points, np.zeros(len(points))]) @ R.T + t)[:, :2]


@pytest.fixture(params=['tf', 'parameter'])
def feed(request):
    by_tf = request.param == 'tf'
    node = Node() if by_tf else Node(laser_upside_down=True, laser_pose=tuple(PLACE))
    feed = SensorInput(Parameters(node=node), Target(), InputCounts())
    if by_tf:
        feed.extrinsics.add([Transform('base_link', 'laser', *upside_down())])
    return feed


def place(feed):
    return feed._target.places.get('laser', PLACE)


def test_scan_of_a_laser_upside_down_is_where_its_rays_end(feed):
    feed.add('scan', encode.laser_scan(make_bag, SCAN))
    (scan,) = feed._target.given
    assert scan.time_increment == SCAN.time_increment
    points = project(scan, place(feed), np.zeros((1, 3)), 30.0)
    rays = SCAN.ranges[:, None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)
    np.testing.assert_allclose(points, in_base(rays), atol=1e-6)


def test_reflectors_of_a_laser_upside_down_are_on_its_other_side(feed):
    message = encode.detections(make_bag, SEEN)
    feed.add('reflectors', message)
    (seen,) = feed._target.given
    T = place(feed)
    c, s = np.cos(T[2]), np.sin(T[2])
    np.testing.assert_allclose(
        seen.points @ np.array([[c, s], [-s, c]]) + T[:2], in_base(FOUND), atol=1e-6
    )
    # noise along and across a beam is as it was
    plain = decode.detections(message, Parameters().reflector)
    for quarter in (np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])):
        now, before = (
            np.einsum('ni,nij,nj->n', d.points @ quarter, d.cov, d.points @ quarter)
            for d in (seen, plain)
        )
        np.testing.assert_allclose(now, before, rtol=1e-6)


def test_sensor_in_the_base_frame_does_not_hang():
    feed = SensorInput(Parameters(node=Node(laser_upside_down=True)), Target(), InputCounts())
    feed.add('scan', encode.laser_scan(make_bag, replace(SCAN, frame_id='base_link')))
    assert feed._target.given[0].angle_min == SCAN.angle_min


def test_farthest_range_of_inf_makes_no_range_of_inf():
    ranges = SCAN.ranges.copy()
    ranges[3] = np.inf
    feed = SensorInput(Parameters(), Target(), InputCounts())
    feed.add('scan', encode.laser_scan(make_bag, replace(SCAN, range_max=np.inf, ranges=ranges)))
    (scan,) = feed._target.given
    assert np.isfinite(scan.range_max)
    assert len(project(scan, np.zeros(3), np.zeros((1, 3)), 30.0)) == len(ranges) - 1


def many(points):
    n = len(points)
    return Detections(
        5, 'laser', points, np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, -1),
        np.full(n, np.nan),
    )  # fmt: skip


def test_points_of_a_scan_are_no_reflectors():
    inputs = InputCounts()
    feed = SensorInput(Parameters(), Target(), inputs)
    angles = np.linspace(-2.0, 2.0, 300)
    walls = 4.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    feed.add('reflectors', encode.detections(make_bag, many(walls)))
    assert not feed._target.given
    assert inputs.counts['reflectors'] == {'invalid': 1}
    assert 'reflectors: 299 of 300 points are less than 0.25 m' in inputs.last_error


def test_many_reflectors_and_a_few_seen_twice_are_used():
    feed = SensorInput(Parameters(), Target(), InputCounts())
    x, y = np.meshgrid(np.arange(10.0), np.arange(12.0))
    racks = np.column_stack([x.ravel(), y.ravel()]) + 1.0
    few = np.full((10, 2), 3.0) + 1e-2 * np.arange(10)[:, None]
    twice = np.repeat(racks, 2, axis=0) + 0.05 * (np.arange(240) % 2)[:, None]
    filled = np.vstack([racks[:12], np.zeros((60, 2))])
    two_lasers = np.vstack([racks, racks + 0.05])
    for points in (racks, twice, filled, two_lasers, few):
        feed.add('reflectors', encode.detections(make_bag, many(points)))
        assert len(feed._target.given[-1]) == len(points)


@pytest.mark.parametrize(
    ('rows', 'used'),
    [
        # numbers of the rows, from 0 or 1 on, and where rows were left out
        ([[0], [0, 1], [0, 1, 2], [0, 1]], [False] * 4),
        ([[1, 2, 3], [1], [1, 2]], [False] * 3),
        ([[0, 2, -1], [0, 1, 3, -1]], [False] * 2),
        # names: one message shows it for all that follow
        ([[7]], [True]),
        ([[0, 1], [1, 0], [0]], [False, True, True]),
        ([[0, 1, 2], [2, 9], [0, 1], []], [False, True, True, True]),
        ([[-1, -1], [0], [4, 4], [5]], [False, False, False, True]),
    ],
)
def test_ids_are_used_once_they_are_more_than_numbers_of_rows(rows, used):
    feed = SensorInput(Parameters(), Target(), InputCounts())
    for ids, are_used in zip(rows, used, strict=True):
        n = len(ids)
        seen = Detections(
            5, 'laser', np.arange(2.0 * n).reshape(n, 2) + 1.0, np.tile(np.eye(2), (n, 1, 1)),
            np.array(ids, dtype=np.int64), np.full(n, np.nan),
        )  # fmt: skip
        feed.add('reflectors', encode.detections(make_bag, seen))
        got = feed._target.given[-1].ids.tolist()
        assert got == (ids if are_used else [-1] * n)
    feed.add('reflectors', encode.detections(make_bag, SEEN))
    assert len(feed._target.given) == len(rows) + 1
