# SPDX-License-Identifier: Apache-2.0
"""The pictures of the map for RViz and Foxglove."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.ros.codecs.graph_markers import graph_markers
from rlml_slam.ros.codecs.markers import SCALE_95, detection_markers, ellipse, reflector_markers
from rlml_slam.ros.codecs.message_types import make_bag, make_rclpy, rclpy_class
from rlml_slam.types import EdgeKind, Reflectors, Status

MAKES = [make_bag]
if rclpy_class('visualization_msgs/msg/Marker') is not None:
    MAKES.append(make_rclpy)


def some_reflectors(n=2):
    R = se2.rotation(0.5)
    cov = R @ np.diag([0.04, 0.01]) @ R.T
    return Reflectors(
        np.arange(n) + 10, np.full((n, 2), 3.0), np.repeat(cov[None], n, 0),
        np.full(n, -1), np.full(n, 5), np.array([0.08, np.nan])[:n],
    )  # fmt: skip


def test_ellipse_holds_95_percent():
    cov = some_reflectors().cov[0]
    major, minor, heading = ellipse(cov)
    # chi^2 with 2 degrees of freedom: 1 - exp(-s^2 / 2) = 0.95
    assert math.exp(-0.5 * SCALE_95**2) == pytest.approx(0.05, abs=1e-5)
    assert (major, minor) == pytest.approx((2 * SCALE_95 * 0.2, 2 * SCALE_95 * 0.1))
    assert math.sin(heading - 0.5) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize('make', MAKES)
def test_each_reflector_has_body_ellipse_and_key(make):
    markers = reflector_markers(make, 1, 'map', some_reflectors()).markers
    assert [m.ns for m in markers[1:]] == ['reflectors', 'ellipses', 'keys'] * 2
    assert markers[0].action == 3
    assert len({m.id for m in markers}) == len(markers)
    assert [m.text for m in markers if m.ns == 'keys'] == ['10', '11']
    assert markers[1].scale.x == pytest.approx(0.08)


@pytest.mark.parametrize('make', MAKES)
def test_detections_are_drawn_by_what_became_of_them(make):
    points = np.arange(12.0).reshape(6, 2)
    statuses = np.array([Status.USED, Status.NEW, Status.USED, Status.GATED, Status.GHOST, 4])
    drawn = detection_markers(make, 1, 'base_link', points, statuses).markers
    assert drawn[0].action == 3
    found = {m.ns: [(p.x, p.y) for p in m.points] for m in drawn[1:]}
    assert found == {
        'used': [(0.0, 1.0), (4.0, 5.0)], 'new': [(2.0, 3.0)], 'gated': [(6.0, 7.0)],
        'ghost': [(8.0, 9.0)], 'ambiguous': [(10.0, 11.0)],
    }  # fmt: skip
    colors = {(m.color.r, m.color.g, m.color.b) for m in drawn[1:]}
    assert len(colors) == 5


@pytest.mark.parametrize('make', MAKES)
def test_edges_are_drawn_by_kind_and_disabled_ones_left_out(make):
    graph = Graph()
    graph.add_poses(np.arange(9.0).reshape(3, 3))
    graph.add_landmark([5.0, 5.0])
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1, 0, 0], np.eye(3))
    closure = graph.add_edge(EdgeKind.CLOSURE, 0, 2, [1, 0, 0], np.eye(3))
    graph.add_sighting(2, 0, [1, 1], np.eye(2))
    drawn = {m.ns: m for m in graph_markers(make, 1, 'map', graph).markers}
    assert {'keyframes', 'odometry', 'closure', 'sightings'} <= drawn.keys()
    assert len(drawn['keyframes'].points) == 3
    assert [(p.x, p.y) for p in drawn['closure'].points] == [(0.0, 1.0), (6.0, 7.0)]
    assert [(p.x, p.y) for p in drawn['sightings'].points] == [(6.0, 7.0), (5.0, 5.0)]
    graph.edges.enabled[closure] = False
    assert 'closure' not in {m.ns for m in graph_markers(make, 1, 'map', graph).markers}
