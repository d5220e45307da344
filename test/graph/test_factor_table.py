# SPDX-License-Identifier: Apache-2.0
import copy
import pickle

import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.factor_table import Column, is_positive_definite
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.types import EdgeKind


def two_poses() -> Graph:
    graph = Graph()
    graph.add_pose([0, 0, 0], fixed=True)
    graph.add_pose([1, 0, 0])
    graph.add_landmark([2, 2])
    return graph


def test_column_keeps_its_rows_while_it_grows_and_copies_rarely():
    column, buffers = Column((2,)), set()
    for k in range(1000):
        column.append(np.full((1, 2), float(k)))
        buffers.add(id(column._buffer))
    np.testing.assert_array_equal(column.view[:, 1], np.arange(1000.0))
    assert len(buffers) <= 7  # 16 doubled to 1024


def test_indices_count_up_and_tables_hold_what_was_added():
    graph = two_poses()
    e = graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1, 0, 0], np.eye(3))
    f = graph.add_edges(
        [EdgeKind.CLOSURE, EdgeKind.SCAN], [[1, 0], [0, 1]], np.zeros((2, 3)), [np.eye(3)] * 2
    )
    s = graph.add_sighting(1, 0, [1, 2], 4 * np.eye(2))
    assert (e, list(f), s) == (0, [1, 2], 0)
    assert list(graph.edges.kinds) == [
        FactorKind.ODOMETRY, FactorKind.CLOSURE, FactorKind.SCAN
    ]  # fmt: skip
    assert graph.edges.describe(1) == 'factor 1 (closure, pose 1 to pose 0)'
    np.testing.assert_array_equal(graph.sightings.information[0], 4 * np.eye(2))


def test_chi2_counts_enabled_factors_alone():
    graph = two_poses()
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [0, 0, 0], np.eye(3))
    graph.add_edge(EdgeKind.CLOSURE, 0, 1, [3, 0, 0], np.eye(3))
    assert graph.chi2() == pytest.approx(1 + 4)
    graph.edges.enabled[1] = False
    assert graph.chi2() == pytest.approx(1)


@pytest.mark.parametrize(
    ('i', 'j', 'delta', 'information', 'match'),
    [
        (0, 5, [1, 0, 0], np.eye(3), r'factor 0 \(closure, pose 0 to pose 5\): unknown node'),
        (-1, 1, [1, 0, 0], np.eye(3), 'unknown node'),
        (1, 1, [1, 0, 0], np.eye(3), 'both ends are the same'),
        (0, 1, [1, np.nan, 0], np.eye(3), r'pose 0 to pose 1\): measured value .*not finite'),
        (0, 1, [1, 0, 0], np.diag([1, 1, 0]), 'not symmetric positive definite'),
        (0, 1, [1, 0, 0], np.diag([1, 1, np.inf]), 'not symmetric positive definite'),
        (0, 1, [1, 0, 0], np.diag([1, -1, 1]), 'not symmetric positive definite'),
        (0, 1, [1, 0, 0], np.eye(3) + np.eye(3, k=1) / 2, 'not symmetric positive definite'),
        (0, 1, [1, 0], np.eye(3), '1 factors between'),
    ],
)
def test_bad_edge_is_refused_by_name_and_nothing_is_added(i, j, delta, information, match):
    graph = two_poses()
    with pytest.raises(SolverError, match=match):
        graph.add_edge(EdgeKind.CLOSURE, i, j, delta, information)
    assert len(graph.edges) == 0


def test_bad_node_is_refused_by_name():
    graph = two_poses()
    with pytest.raises(SolverError, match=r'pose 2: .*not finite'):
        graph.add_pose([0, np.inf, 0])
    with pytest.raises(SolverError, match=r'landmark 1: .*not finite'):
        graph.add_landmark([np.nan, 0])
    with pytest.raises(SolverError, match='unknown node'):
        graph.add_sighting(0, 1, [0, 0], np.eye(2))
    assert (len(graph.poses), len(graph.landmarks)) == (2, 1)


def test_positive_definite_agrees_with_eigenvalues():
    rng = np.random.default_rng(0)
    a = rng.standard_normal((500, 3, 3))
    matrices = np.concatenate([a @ np.swapaxes(a, 1, 2), a + np.swapaxes(a, 1, 2)])
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    clear = np.abs(smallest) > 1e-6  # away from the tolerance
    np.testing.assert_array_equal(is_positive_definite(matrices)[clear], (smallest > 0)[clear])


def test_column_goes_on_after_it_has_let_rows_go():
    column = Column((2,))
    rows = np.arange(40.0).reshape(20, 2)
    column.append(rows)
    kept = np.arange(20) % 3 == 0
    column.keep(kept)
    np.testing.assert_array_equal(column.view, rows[kept])
    column.append(rows)
    assert len(column) == 27
    np.testing.assert_array_equal(column.view, np.vstack([rows[kept], rows]))


@pytest.mark.parametrize('copied', [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
@pytest.mark.parametrize('rows', [0, 3, 40])
def test_a_copy_keeps_what_is_written_to_it_when_it_grows(copied, rows):
    column = Column((2,))
    column.append(np.ones((rows, 2)))
    other = copied(column)
    other.view[:] = 7.0
    other.append(np.zeros((1, 2)))
    np.testing.assert_array_equal(other.view, [[7.0, 7.0]] * rows + [[0.0, 0.0]])
    np.testing.assert_array_equal(column.view, np.ones((rows, 2)))


def test_places_are_those_of_the_buffers_whatever_becomes_of_them():
    """A graph that has grown, let go of nodes or is a copy has others."""
    graph = loop_graph(0)[0]
    first = graph.addresses()
    assert graph.addresses() is first
    copies = [copy.deepcopy(graph), pickle.loads(pickle.dumps(graph))]
    graph.add_pose([0.0, 0.0, 0.0])
    assert graph.addresses().at[0].tolist() == [graph.poses.ctypes.data, 31]
    graph.add_poses(np.zeros((99, 3)))
    kept = np.arange(130) < 20
    graph.keep(kept, np.ones(8, np.bool_))
    for one in (graph, *copies):
        at, buffers = one.addresses()
        t = one.tables()
        now = (
            one.poses, one.landmarks, t.fixed_poses, t.fixed_landmarks,
            *t.edges, *t.sightings, *t.pose_priors, *t.landmark_priors,
        )  # fmt: skip
        assert len(at) == len(buffers) == len(now)
        for (address, length), array in zip(at.tolist(), now, strict=True):
            assert (address, length) == (array.ctypes.data, len(array))


def test_solving_a_copy_leaves_the_graph_alone():
    graph = loop_graph(1, start_noise=1.0)[0]
    optimize(graph)
    graph.poses[1:] += 0.1
    before = graph.poses.copy()
    other = copy.deepcopy(graph)
    optimize(other)
    np.testing.assert_array_equal(graph.poses, before)
    optimize(graph)
    np.testing.assert_array_equal(graph.poses, other.poses)
