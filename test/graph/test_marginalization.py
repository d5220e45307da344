# SPDX-License-Identifier: Apache-2.0
from itertools import combinations

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.factors import relative_information
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.reduction.marginalization import (
    RelativePoses,
    floored_covariance,
    fuse,
    marginalize_pose,
)
from rlml_slam.params import Solver
from rlml_slam.types import EdgeKind

NO_FLOOR = np.full(3, 1e-12)


def random_cov(rng, d=3, scale=1e-2):
    A = rng.standard_normal((d, d))
    return scale**2 * (A @ A.T + 0.2 * np.eye(d))


def chain(rng, n, noise=0.0):
    """A graph of n poses, each tied to the one before it."""
    graph = Graph()
    true = [np.array([0.5, -1.0, 0.3])]
    graph.add_pose(true[0], fixed=True)
    for k in range(1, n):
        true.append(se2.compose(true[-1], rng.uniform((0.2, -0.3, -1.0), (0.9, 0.3, 1.0))))
        graph.add_pose(true[-1])
        tie(graph, rng, k - 1, k, true, noise)
    return graph, true


def tie(graph, rng, i, j, true, noise=0.0, kind=EdgeKind.ODOMETRY, scale=1e-2):
    delta = se2.between(true[i], true[j])
    cov = random_cov(rng, scale=scale)
    measured = delta + noise * np.linalg.cholesky(cov) @ rng.standard_normal(3)
    graph.add_edge(kind, i, j, measured, relative_information(measured, cov))


def kept(graph, *removed):
    """Let the poses go, with their tables."""
    mask = np.ones(len(graph.poses), dtype=bool)
    mask[list(removed)] = False
    return graph.keep(mask, np.ones(len(graph.landmarks), dtype=bool))


@pytest.mark.parametrize('seed', range(5))
def test_pose_of_a_chain_leaves_without_any_loss(seed):
    rng = np.random.default_rng(seed)
    graph, _ = chain(rng, 5)
    before = Marginals(graph).joint([1, 3, 4])
    done = marginalize_pose(graph, 2, NO_FLOOR)
    assert done.hub in (1, 3)
    assert sorted(done.edges) == [1, 2]
    new = kept(graph, 2)
    np.testing.assert_array_equal(new.poses, [0, 1, -1, 2, 3])
    # a chain is a tree: the marginal is exact, up to the rounding of two inverses
    np.testing.assert_allclose(Marginals(graph).joint([1, 2, 3]), before, rtol=1e-6, atol=1e-12)
    assert graph.chi2() == pytest.approx(0.0, abs=1e-12)


def test_optimum_of_a_noisy_chain_stays():
    rng = np.random.default_rng(7)
    graph, _ = chain(rng, 6, noise=1.0)
    optimize(graph, Solver())
    before = graph.poses.copy()
    for pose in (2, 3):
        marginalize_pose(graph, pose, NO_FLOOR)
    kept(graph, 2, 3)
    optimize(graph, Solver())
    np.testing.assert_allclose(graph.poses, before[[0, 1, 4, 5]], atol=1e-9)


@pytest.mark.parametrize('seed', range(5))
def test_star_leaves_a_tree_whose_relative_marginals_are_exact(seed):
    rng = np.random.default_rng(seed)
    graph = Graph()
    true = [np.array([0.0, 0.0, 0.4])] + [rng.uniform(-2.0, 2.0, 3) for _ in range(4)]
    graph.add_poses(np.array(true))
    graph.fixed_poses[1] = True
    for k in range(1, 5):
        tie(graph, rng, *((0, k) if k % 2 else (k, 0)), true)
    joint = Marginals(graph).joint([1, 2, 3, 4])
    done = marginalize_pose(graph, 0, NO_FLOOR)
    kept(graph, 0)
    after = Marginals(graph).joint([0, 1, 2, 3])
    edges = graph.edges.nodes.tolist()
    assert len(edges) == 3
    assert all(i == done.hub - 1 for i, _ in edges)
    for i, j in edges:
        J = np.hstack(se2.between_jacobians(graph.poses[i], graph.poses[j]))
        at = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
        for cov in (joint, after):
            got = J @ cov[np.ix_(at, at)] @ J.T
            np.testing.assert_allclose(got, J @ joint[np.ix_(at, at)] @ J.T, rtol=1e-6, atol=1e-12)
    # what was dropped is what the edges had in common: no relative pose became better known
    for i, j in combinations(range(4), 2):
        J = np.hstack(se2.between_jacobians(graph.poses[i], graph.poses[j]))
        at = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
        worse = J @ (after - joint)[np.ix_(at, at)] @ J.T
        assert np.linalg.eigvalsh(worse).min() > -1e-9


def test_edges_that_are_there_already_are_joined_and_told_of():
    rng = np.random.default_rng(3)
    graph, true = chain(rng, 3)
    tie(graph, rng, 2, 0, true)
    tie(graph, rng, 0, 2, true, kind=EdgeKind.CLOSURE)
    before = Marginals(graph).poses([2])
    done = marginalize_pose(graph, 1, NO_FLOOR)
    # both odometry edges and the one of their kind beside them are in the new one
    assert {k: v for k, v in done.edges.items() if v >= 0}.keys() >= {2}
    new = kept(graph, 1)
    assert len(graph.edges) == 3  # the closure, the joined one, and the disabled one beside it
    assert graph.edges.enabled.sum() == 2
    assert new.edges[3] >= 0
    np.testing.assert_allclose(Marginals(graph).poses([1]), before, rtol=1e-6)


def test_closure_stays_a_closure():
    rng = np.random.default_rng(4)
    graph, true = chain(rng, 4)
    tie(graph, rng, 0, 2, true, kind=EdgeKind.CLOSURE, scale=1.0)  # as weak as no odometry is
    done = marginalize_pose(graph, 2, NO_FLOOR)
    edges = graph.edges
    assert edges.kinds[edges.enabled].tolist() == [0, 2, 0]
    assert edges.kinds[done.edges[3]] == 2


def test_many_fused_estimates_are_no_better_than_what_they_have_in_common():
    floor2 = np.array([1e-4, 1e-4, 4e-6])
    one = RelativePoses(np.array([1.0, 2.0, 0.1]), np.diag([4e-4, 4e-4, 4e-5]))
    n = 1000
    many = RelativePoses(np.tile(one.T, (n, 1)), np.tile(one.cov, (n, 1, 1)))
    out = fuse(many, np.zeros(n, dtype=np.int64), 1, floor2)
    np.testing.assert_allclose(out.T[0], one.T, atol=1e-12)
    np.testing.assert_allclose(out.cov[0], np.diag(floor2), rtol=1e-9)


def test_limit_leaves_alone_what_is_better_already():
    rng = np.random.default_rng(5)
    small = random_cov(rng, scale=1e-5)[None]
    at = np.zeros(1, dtype=np.int64)
    out = floored_covariance(small, np.full(3, 1e-4), small, at)
    np.testing.assert_allclose(out, small, rtol=1e-9)


def test_pose_without_edges_is_refused():
    graph = Graph()
    graph.add_pose(np.zeros(3))
    with pytest.raises(SolverError, match='pose 0 has no edge'):
        marginalize_pose(graph, 0, NO_FLOOR)


def test_where_neighbours_cannot_be_tied_the_graph_stays_as_it_was():
    """Surely so far along the way, and by any heading anywhere across it."""
    graph = Graph()
    for x in (0.0, 100.0, 101.0):
        graph.add_pose([x, 0.0, 0.0])
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [100.0, 0.0, 0.0], np.diag([1e8, 1e8, 1e-8]))
    graph.add_edge(EdgeKind.SCAN, 1, 2, [1.0, 0.0, 0.0], np.diag([1e8, 1e8, 1e8]))
    graph.add_edge(EdgeKind.SCAN, 0, 2, [101.0, 0.0, 0.0], np.diag([1.0, 1.0, 1.0]))
    with pytest.raises(SolverError, match='pose 1 cannot be marginalized'):
        marginalize_pose(graph, 1, NO_FLOOR)
    assert len(graph.edges) == 3
    assert graph.edges.enabled.all()
