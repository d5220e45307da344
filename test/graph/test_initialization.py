# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_lab.bench.generated_graphs import city
from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.initialization import METHODS, initialize
from rlml_slam.graph.model.graph import Graph
from rlml_slam.types import EdgeKind


@pytest.mark.parametrize('method', METHODS[1:])
def test_noiseless_graph_is_placed_exactly_from_any_start(method):
    graph, truth, points = loop_graph(noise=0.0)
    graph.poses[1:] = np.random.default_rng(0).uniform(-50, 50, (29, 3))
    graph.landmarks[:] = 0.0
    initialize(graph, method)
    # rounding of 30 compositions, or of one sparse solve
    np.testing.assert_allclose(graph.poses[:, :2], truth[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(graph.poses[:, 2] - truth[:, 2]), 0.0, atol=1e-9)
    np.testing.assert_allclose(graph.landmarks, points, atol=1e-9)


def test_chordal_start_is_near_the_truth_where_odometry_is_far():
    graph, _, _ = loop_graph(seed=1, noise=4.0, poses=200, landmarks=0)
    initialize(graph, 'odometry')
    far = graph.chi2()
    initialize(graph, 'chordal')
    assert graph.chi2() < 0.1 * far


def test_relaxed_headings_that_fade_to_nothing_are_taken_all_the_same():
    graph = city(3000, sigma=np.array([0.05, 0.05, 0.7]))
    graph.poses[1:, 2] = start = 2.0
    initialize(graph, 'chordal')
    assert not (graph.poses[1:, 2] == start).any()


def test_fixed_nodes_are_not_moved():
    graph, _, _ = loop_graph(seed=3)
    graph.fixed_poses[[5, 9]] = True
    graph.fixed_landmarks[2] = True
    graph.poses[9] = [1, 2, 3]
    before = graph.poses[[0, 5, 9]].copy(), graph.landmarks[2].copy()
    for method in METHODS:
        initialize(graph, method)
        np.testing.assert_array_equal(graph.poses[[0, 5, 9]], before[0])
        np.testing.assert_array_equal(graph.landmarks[2], before[1])


def test_disabled_edges_do_not_carry_the_start():
    graph = Graph()
    graph.add_poses(np.zeros((2, 3)))
    graph.fixed_poses[0] = True
    wrong = graph.add_edge(EdgeKind.CLOSURE, 0, 1, [9, 9, 0], np.eye(3))
    graph.add_edge(EdgeKind.ODOMETRY, 1, 0, [1, 0, 0], np.eye(3))
    graph.edges.enabled[wrong] = False
    initialize(graph, 'spanning_tree')
    np.testing.assert_allclose(graph.poses[1], [-1, 0, 0], atol=1e-15)


def test_unknown_method_is_refused():
    with pytest.raises(SolverError, match="'magic' is none of"):
        initialize(Graph(), 'magic')
