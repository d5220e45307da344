# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from made_graphs import loop_graph
from normal_equations import normal_equations, unknowns

from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.graph import Graph
from rlml_slam.types import EdgeKind


def dense(graph: Graph) -> np.ndarray:
    return np.linalg.inv(normal_equations(graph, unknowns(graph)).H.toarray())


def test_blocks_are_those_of_the_dense_inverse():
    graph, _, _ = loop_graph(seed=1)
    optimize(graph)
    full, columns, marginals = dense(graph), unknowns(graph), Marginals(graph)
    at_p, at_m = columns.poses, columns.landmarks
    poses = marginals.poses(np.arange(1, len(graph.poses)))
    for cov, at in zip(poses, at_p[1:], strict=True):
        # 1e-9 relative: conditioning 1e6 times rounding
        np.testing.assert_allclose(cov, full[at : at + 3, at : at + 3], rtol=1e-9, atol=1e-15)
    landmarks = marginals.landmarks(np.arange(len(graph.landmarks)))
    cross = marginals.cross(len(graph.poses) - 1, np.arange(len(graph.landmarks)))
    p = at_p[-1]
    for cov, both, at in zip(landmarks, cross, at_m, strict=True):
        np.testing.assert_allclose(cov, full[at : at + 2, at : at + 2], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(both, full[p : p + 3, at : at + 2], rtol=1e-7, atol=1e-15)


def test_joint_covariance_is_that_of_the_dense_inverse_and_positive():
    graph, _, _ = loop_graph(seed=2)
    full, columns = dense(graph), unknowns(graph)
    joint = Marginals(graph).joint([7, 3], [1])
    starts = [(columns.poses[7], 3), (columns.poses[3], 3), (columns.landmarks[1], 2)]
    at = np.concatenate([a + np.arange(d) for a, d in starts])
    np.testing.assert_allclose(joint, full[np.ix_(at, at)], rtol=1e-8, atol=1e-15)
    assert (np.linalg.eigvalsh(joint) > 0).all()


def test_fixed_and_untouched_nodes_have_zero_covariance():
    graph, _, _ = loop_graph()
    i = graph.add_pose([9, 9, 0])
    marginals = Marginals(graph)
    np.testing.assert_array_equal(marginals.poses([0, i]), np.zeros((2, 3, 3)))
    np.testing.assert_array_equal(marginals.joint([0], [0])[:3], 0.0)


def test_chain_accumulates_the_covariance_of_its_edges():
    graph = Graph()
    graph.add_poses([[k, 0, 0] for k in range(4)])
    graph.fixed_poses[0] = True
    for k in range(3):
        graph.add_edge(EdgeKind.ODOMETRY, k, k + 1, [1, 0, 0], np.diag([1e2, 1e2, 1e4]))
    cov = Marginals(graph).poses([3])[0]
    # heading errors of 0.01 rad at 2 m and 1 m of leverage: 1e-4 (4 + 1)
    expected = [[0.03, 0, 0], [0, 0.03 + 5e-4, 3e-4], [0, 3e-4, 3e-4]]
    np.testing.assert_allclose(cov, expected, rtol=1e-9, atol=1e-12)


def test_revoking_a_closure_widens_the_covariance():
    graph, _, _ = loop_graph(landmarks=0)
    before = Marginals(graph).poses([29])[0]
    graph.edges.enabled[graph.edges.kinds == 2] = False
    after = Marginals(graph).poses([29])[0]
    assert np.trace(after) > 1.2 * np.trace(before)


def test_unknown_pose_is_an_index_error():
    graph, _, _ = loop_graph()
    with pytest.raises(IndexError):
        Marginals(graph).poses([30])
