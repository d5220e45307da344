# SPDX-License-Identifier: Apache-2.0
"""Pruning removes redundant edges, and no covariance gets smaller by it."""

from __future__ import annotations

import numpy as np
import pytest
from made_graphs import loop_graph
from scipy import sparse

from rlml_slam import se2
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.incremental.incremental_solver import IncrementalSolver
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.incremental.solver_state import IN_USE
from rlml_slam.graph.model.factors import Losses, pose_landmark, relative_pose
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.graph.reduction.edge_pruning import (
    MAX_LEVERAGE,
    leverages,
    prune_edges,
    prune_sightings,
    sighting_leverages,
)
from rlml_slam.types import EdgeKind

EVERY = EdgeKind.SCAN


def tie(graph, i, j, worth=1.0, off=(0.0, 0.0, 0.0)):
    delta = se2.between(graph.poses[i], graph.poses[j]) + off
    return graph.add_edge(EVERY, i, j, delta, worth * np.diag([1e4, 5e3, 1e5]))


def crowd(rng, poses=40, edges=400):
    graph = Graph()
    graph.add_poses(rng.uniform(-3.0, 3.0, (poses, 3)))
    graph.fixed_poses[0] = True
    for k in range(poses - 1):
        tie(graph, k, k + 1)
    add(graph, rng, edges)
    return graph


def add(graph, rng, edges):
    for _ in range(edges):
        tie(graph, *rng.choice(len(graph.poses), 2, replace=False), rng.uniform(0.1, 2.0))


def everything(graph):
    return np.ones(len(graph.edges), dtype=bool)


def test_covariances_between_the_ends_of_edges_are_those_of_the_inverse():
    graph, _, _ = loop_graph(3)
    graph.edges.enabled[4] = False
    marginals, n = Marginals(graph), len(graph.poses)
    joint = marginals.joint(np.arange(n)).reshape(n, 3, n, 3).swapaxes(1, 2)
    i, j = graph.edges.nodes[graph.edges.enabled].T
    np.testing.assert_allclose(marginals.edges(), joint[i, j], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('seed', range(3))
def test_leverages_sum_up_to_the_free_poses(seed):
    """Of edges alone: tr(H^-1 sum J^T W J) is the number of unknowns, three per pose."""
    graph = crowd(np.random.default_rng(seed))
    h = np.trace(leverages(graph), axis1=1, axis2=2)
    assert h.sum() == pytest.approx(3.0 * 39, rel=1e-9)
    assert (h > 0.0).all()
    assert (h < 3.0).all()


def test_edge_that_is_the_only_way_has_all_the_leverage():
    graph = crowd(np.random.default_rng(0))
    graph.add_pose([9.0, 9.0, 1.0])
    bridge = tie(graph, 3, 40)
    np.testing.assert_allclose(leverages(graph)[bridge], np.eye(3), atol=1e-6)


def test_outlier_counts_what_its_loss_leaves_of_it():
    graph = crowd(np.random.default_rng(1))
    edge = tie(graph, 3, 30, off=(2.0, 0.0, 0.0))
    before = np.trace(leverages(graph)[edge])
    graph.losses = Losses(scan=Loss(LossKind.CAUCHY, 3.0))
    assert np.trace(leverages(graph)[edge]) < 0.01 * before


@pytest.mark.parametrize('seed', range(5))
def test_what_goes_makes_nothing_surer_and_takes_less_than_its_share(seed):
    graph = crowd(np.random.default_rng(seed))
    most = len(graph.edges) - 1
    before = Marginals(graph).joint(np.arange(1, 40))
    (removed,) = prune_edges(graph, everything(graph), most)
    after = Marginals(graph).joint(np.arange(1, 40))
    scale = np.sqrt(np.diag(before))
    assert np.linalg.eigvalsh((after - before) / np.outer(scale, scale)).min() > -1e-9
    i, j = graph.edges.nodes[removed]
    X = graph.poses
    J = np.hstack(relative_pose(X[i], X[j], se2.between(X[i], X[j]))[1:])
    at = np.concatenate([3 * (i - 1) + np.arange(3), 3 * (j - 1) + np.arange(3)])
    if 0 not in (i, j):
        known = [J @ cov[np.ix_(at, at)] @ J.T for cov in (before, after)]
        # one edge of ten per pose has less than a tenth of the leverage: of the mean variance
        grown = np.trace(np.linalg.solve(known[0], known[1])) / 3.0
        assert 1.0 < grown < 1.2


@pytest.mark.parametrize('seed', range(3))
def test_graph_stays_in_one_piece_however_few_edges_are_asked_for(seed):
    rng = np.random.default_rng(seed)
    graph = crowd(rng, 20, 40)
    for _ in range(200):
        if not len(prune_edges(graph, everything(graph), 0)):
            break
    nodes = graph.edges.nodes[graph.edges.enabled]
    links = sparse.csr_matrix((np.ones(len(nodes)), nodes.T), (20, 20))
    assert sparse.csgraph.connected_components(links, directed=False)[0] == 1
    # until each of them has a good part of some direction to itself
    h = np.linalg.eigvals(leverages(graph)).real.max(axis=1)
    assert h.min() >= MAX_LEVERAGE
    assert len(nodes) < 59


def test_number_of_edges_is_held_where_others_come_all_the_time():
    rng = np.random.default_rng(0)
    graph = crowd(rng, 40, 120)
    for _ in range(30):
        add(graph, rng, 2)
        prune_edges(graph, everything(graph), 160)
    assert graph.edges.enabled.sum() == 160


def test_factor_does_not_fill_however_long_edges_come_and_go():
    """Submaps tie many poses to one, in each lap to another one."""
    rng = np.random.default_rng(0)
    graph = crowd(rng, 100, 0)
    filled = []
    for lap in range(13):
        for hub in rng.choice(100, 4, replace=False):
            for other in rng.choice(100, 30, replace=False):
                if hub != other:
                    tie(graph, hub, other)
        while len(prune_edges(graph, everything(graph), 300)):
            pass
        if lap:  # the first one leaves fewer edges than that
            filled.append(room(graph))
    # by leverage alone it doubles; by that times the number of neighbours the last are 0.88
    assert max(filled) < 1.3 * filled[0], filled
    assert np.mean(filled[-4:]) < 0.85 * filled[0], filled


def room(graph):
    """Elements of the factor, ordered as a whole."""
    solver = IncrementalSolver(graph)
    solver.update(whole=True)
    return int(solver._state.counts[IN_USE])


def test_no_edge_goes_that_may_not_or_is_not_too_many():
    graph = crowd(np.random.default_rng(2))
    may = everything(graph)
    may[100:] = False
    assert len(prune_edges(graph, may, len(may))) == 0
    removed = prune_edges(graph, may, len(may) - 5)
    assert len(removed) == 5
    assert removed.max() < 100
    assert graph.edges.enabled.sum() == len(may) - 5


def with_reflectors(rng, landmarks=12, sightings=30):
    """A crowd whose pose 5 has seen a lot, some twice, by measurements of different worth."""
    graph = crowd(rng, 20, 60)
    graph.add_landmarks(rng.uniform(-5.0, 5.0, (landmarks, 2)))
    for k in range(landmarks):
        for pose in rng.choice(20, 3, replace=False):
            see(graph, rng, pose, k)
    for _ in range(sightings):
        see(graph, rng, 5, rng.integers(landmarks))
    return graph


def see(graph, rng, pose, k):
    z = pose_landmark(graph.poses[pose], graph.landmarks[k], np.zeros(2))[0]
    graph.add_sighting(pose, k, z, 10.0 ** rng.uniform(0.0, 4.0) * np.eye(2))


@pytest.mark.parametrize('seed', range(3))
def test_leverage_of_a_sighting_is_the_share_that_it_has_in_what_is_known(seed):
    graph = with_reflectors(np.random.default_rng(seed))
    s = graph.sightings
    use = np.flatnonzero(s.nodes[:, 0] == 5)
    h = sighting_leverages(OnlineSolver(graph), 5, use)
    marginals = Marginals(graph)
    for row, k in zip(use, s.nodes[use, 1], strict=True):
        _, J_x, J_m = pose_landmark(graph.poses[5], graph.landmarks[k], s.measured[row])
        J = np.hstack([J_x, J_m])
        expected = J @ marginals.joint([5], [k]) @ J.T @ s.information[row]
        np.testing.assert_allclose(h[row == use][0], expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize('seed', range(5))
def test_sightings_that_go_make_nothing_surer_and_take_less_than_their_share(seed):
    graph = with_reflectors(np.random.default_rng(seed))
    live, s = OnlineSolver(graph), graph.sightings
    others = s.nodes[:, 0] != 5
    num = int(np.sum(~others))
    before = Marginals(graph).joint(np.arange(1, 20), np.arange(12))
    removed = prune_sightings(live, 5, num - 6)
    after = Marginals(graph).joint(np.arange(1, 20), np.arange(12))
    assert 0 < len(removed) <= 6
    assert s.enabled[others].all()
    assert not s.enabled[removed].any()
    scale = np.sqrt(np.diag(before))
    assert np.linalg.eigvalsh((after - before) / np.outer(scale, scale)).min() > -1e-9
    # what goes has less than MAX_LEVERAGE of a sighting together: det(1 - sum h) bounds the growth
    assert np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1] < 2.0 * np.log(2.0)


def test_the_only_sightings_of_a_reflector_stay():
    graph = with_reflectors(np.random.default_rng(1))
    live, alone = OnlineSolver(graph), graph.add_landmark([3.0, 3.0])
    see(graph, np.random.default_rng(0), 5, alone)
    while len(prune_sightings(live, 5, 0)):
        pass
    s = graph.sightings
    assert s.enabled[s.nodes[:, 1] == alone].all()
