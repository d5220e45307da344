# SPDX-License-Identifier: Apache-2.0
"""Bounds along the surest ways: never less than what the graph knows."""

from __future__ import annotations

import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_slam import se2
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.model.factors import relative_pose
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.path_bound import path_bound
from rlml_slam.types import EdgeKind


def known(graph, i, j):
    """Sigma [m], [rad] of where pose j is, seen from pose i, of all that the graph knows."""
    X = graph.poses
    _, A, B = relative_pose(X[i], X[j], se2.between(X[i], X[j]))
    J = np.hstack([A, B])
    cov = J @ Marginals(graph).joint([i, j]) @ J.T
    return np.sqrt([cov[0, 0] + cov[1, 1], cov[2, 2]])


def line(sigmas, sigma_turn=1e-9):
    graph = Graph()
    graph.add_pose(np.zeros(3), fixed=True)
    for k, sigma in enumerate(sigmas):
        delta = np.array([1.0, 0.3, 0.5])
        graph.add_pose(se2.compose(graph.poses[-1], delta))
        information = np.diag([sigma**-2, sigma**-2, sigma_turn**-2])
        graph.add_edge(EdgeKind.ODOMETRY, k, k + 1, delta, information)
    return graph


def test_one_edge_is_known_as_well_as_it_was_measured_from_either_end():
    graph = Graph()
    graph.add_poses([[1.0, 2.0, 0.4], [2.0, 2.5, -0.9]])
    graph.fixed_poses[0] = True
    A = np.array([[3.0, 0.4, 0.2], [0.0, 2.0, -0.7], [0.0, 0.0, 5.0]])
    graph.add_edge(EdgeKind.SCAN, 0, 1, se2.between(*graph.poses), A.T @ A)
    np.testing.assert_allclose(path_bound(graph, 1, [0])[0], known(graph, 0, 1), rtol=1e-9)
    np.testing.assert_allclose(path_bound(graph, 0, [1])[0], known(graph, 1, 0), rtol=1e-9)


def test_sigmas_add_up_along_a_way():
    graph = line([0.1, 0.2, 0.4])
    assert path_bound(graph, 3, [0, 1, 3])[:, 0] == pytest.approx(
        np.sqrt(2.0) * np.array([0.7, 0.6, 0.0]), rel=1e-6
    )


def test_turn_moves_what_lies_behind_it_by_the_lever():
    graph = line([1e-9] * 5, sigma_turn=0.01)
    levers = np.linalg.norm(graph.poses[1:, :2] - graph.poses[5, :2], axis=1)
    assert path_bound(graph, 5, [0])[0] == pytest.approx([0.01 * levers.sum(), 0.05], rel=1e-6)


def test_loop_that_is_closed_makes_the_way_short():
    graph = line([0.1] * 20)
    before = path_bound(graph, 20, [0, 10])
    graph.add_edge(
        EdgeKind.CLOSURE, 0, 20, se2.between(graph.poses[0], graph.poses[20]), 1e4 * np.eye(3)
    )
    after = path_bound(graph, 20, [0, 10])
    assert after[0, 0] < 0.02 < before[0, 0]
    assert after[1, 0] <= before[1, 0]
    graph.edges.enabled[-1] = False
    np.testing.assert_array_equal(path_bound(graph, 20, [0, 10]), before)


@pytest.mark.parametrize('seed', range(5))
def test_bound_is_never_less_than_what_the_graph_knows(seed):
    graph, _, _ = loop_graph(seed)
    for i in (0, 7, 22):
        bound = path_bound(graph, 15, [i])[0]
        assert (bound >= known(graph, i, 15) * (1.0 - 1e-9)).all()


def test_what_no_way_leads_to_may_be_anywhere():
    graph = line([0.1])
    graph.add_pose(np.ones(3))
    assert np.isinf(path_bound(graph, 2, [0, 1])).all()
