# SPDX-License-Identifier: Apache-2.0
"""Right closures get in, wrong ones stay out, and the optimum is that of the right ones."""

from __future__ import annotations

import numpy as np
import pytest
from made_graphs import SIGMA, WRONG, laps, loop_graph, spoil
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from rlml_slam import params, se2
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.graph.robust.closure_selection import ROUNDS, _Selector, select_closures
from rlml_slam.graph.robust.inlier_evidence import NU, evidence, fit_scale, uniform
from rlml_slam.graph.robust.pairwise_consistency import group
from rlml_slam.graph.robust.spanning_forest import SpanningForest
from rlml_slam.types import EdgeKind

EXACT = params.Solver(max_iterations=100, relative_tolerance=1e-12)


def restated(source, factors):
    """The same graph, with sigmas stated 1 / factors (3,) times as large."""
    graph, e = Graph(), source.edges
    graph.add_poses(source.poses)
    graph.fixed_poses[0] = True
    kinds = [EdgeKind.CLOSURE if k == FactorKind.CLOSURE else EdgeKind.ODOMETRY for k in e.kinds]
    graph.add_edges(kinds, e.nodes, e.measured, e.information * np.outer(factors, factors))
    return graph


def optimum(graph):
    optimize(graph, EXACT)
    return graph.poses.copy()


def test_evidence_is_the_ratio_of_a_student_density_and_a_uniform_one():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((3, 3))
    S, e = A @ A.T + np.eye(3), rng.standard_normal(3)
    student = stats.multivariate_t(shape=0.3 * S, df=NU).logpdf(e)
    expected = student - np.log(1.0 / (25.0 * 2.0 * np.pi))
    assert evidence(e[None], S[None], 0.3, uniform(25.0))[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize('scale', [0.02, 1.0, 30.0])
def test_scale_is_found_among_many_wrong_errors(scale):
    rng = np.random.default_rng(1)
    S = np.diag([0.1, 0.1, 0.05]) ** 2
    right = stats.multivariate_t(shape=scale * S, df=NU).rvs(300, random_state=rng)
    wrong = rng.uniform([-50, -50, -np.pi], [50, 50, np.pi], (700, 3))
    e = np.concatenate([right, wrong])
    found = fit_scale(e, np.broadcast_to(S, (1000, 3, 3)), np.full(1000, uniform(1e4)))
    # 300 errors of 3 components: the relative error of a variance is sqrt(2 / 900) with more for
    # the heavy tails; four of those
    assert found == pytest.approx(scale, rel=0.25)


def test_scale_of_nothing_is_one():
    assert fit_scale(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)) == 1.0


def test_backbone_predicts_what_the_graph_of_odometry_does():
    graph = laps()
    odometry = np.flatnonzero(graph.edges.kinds == FactorKind.ODOMETRY)
    spanning_forest = SpanningForest(graph, odometry)
    graph.edges.enabled[:] = graph.edges.kinds == FactorKind.ODOMETRY
    graph.poses[:] = spanning_forest.poses
    assert graph.chi2() == pytest.approx(0.0, abs=1e-15)
    marginals = Marginals(graph)
    i, j = np.array([0, 5, 100]), np.array([7, 90, 40])
    T, S = spanning_forest.motion(i, j)
    _, J_i, J_j = factors.relative_pose(graph.poses[i], graph.poses[j], T)
    for k in range(3):
        J = np.hstack([J_i[k], J_j[k]])
        expected = J @ marginals.joint([i[k], j[k]]) @ J.T
        assert_allclose(S[k], expected, rtol=1e-6, atol=1e-9)


def test_backbone_of_a_tree_takes_the_way_over_the_fork():
    graph = Graph()
    graph.add_poses(np.zeros((4, 3)), fixed=False)
    for j, x in ((1, 1.0), (2, 2.0)):
        graph.add_edge(EdgeKind.ODOMETRY, 0, j, [x, 0.0, 0.0], np.eye(3))
    graph.add_edge(EdgeKind.ODOMETRY, 3, 2, [0.0, 1.0, 0.0], np.eye(3))
    spanning_forest = SpanningForest(graph, np.arange(3))
    T, S = spanning_forest.motion(np.array([1, 2]), np.array([3, 0]))
    assert_allclose(T[0], [1.0, -1.0, 0.0], atol=1e-12)
    assert_allclose(np.diag(S[1]), [1.0, 5.0, 1.0])  # across: heading error over 2 m besides
    assert S[0][2, 2] == pytest.approx(3.0)  # three edges


def test_columns_between_poses_are_those_of_the_joint_covariance():
    graph = laps()
    marginals = Marginals(graph)
    joint = marginals.joint([9, 40])
    cross = marginals.pose_columns(9, [40, 0])
    assert_allclose(cross[0], joint[:3, 3:], atol=1e-12)
    assert_array_equal(cross[1], 0.0)  # pose 0 is fixed


def test_right_closures_form_groups_and_wrong_ones_do_not():
    graph = laps()
    right = int(np.sum(graph.edges.kinds == FactorKind.CLOSURE))
    spoil(graph, WRONG)
    e, closures = graph.edges, np.flatnonzero(graph.edges.kinds == FactorKind.CLOSURE)
    spanning_forest = SpanningForest(graph, np.flatnonzero(e.kinds == FactorKind.ODOMETRY))
    covs = np.linalg.inv(e.information[closures])
    groups = group(spanning_forest, e.nodes[closures], e.measured[closures], covs, 400.0)
    assert groups.size[groups.label[:right]].min() >= 5
    assert_array_equal(groups.size[groups.label[right:]], 1)
    assert groups.scale == pytest.approx(1.0, rel=0.5)


@pytest.mark.parametrize('factor', [1.0, 0.05, 20.0])
def test_wrong_closures_are_refused_however_wrong_the_covariances_are(factor):
    # the same graph, whose covariances are stated too large or too small
    best = optimum(laps())
    source = laps()
    spoil(source, WRONG)
    graph = restated(source, np.full(3, np.sqrt(factor)))
    chosen = select_closures(graph, EXACT)
    assert_array_equal(chosen.accepted, np.arange(len(chosen.edges)) < len(chosen.edges) - 8)
    assert_array_equal(graph.edges.enabled[chosen.edges], chosen.accepted)
    assert_allclose(graph.poses, best, atol=1e-6)


def test_a_wrong_group_that_agrees_is_refused():
    graph = laps()
    best = optimum(laps())
    # poses 30 .. 35 are taken for 75 .. 80: on a circle the motions agree
    wrong = spoil(graph, [(30 + k, 75 + k) for k in range(6)])
    chosen = select_closures(graph, EXACT)
    assert_array_equal(chosen.edges[~chosen.accepted], wrong)
    assert_allclose(graph.poses, best, atol=1e-6)


@pytest.mark.parametrize('kind', [LossKind.CAUCHY, LossKind.HUBER])
@pytest.mark.parametrize('count', [1, 2, 3])
def test_wrong_closures_that_tear_robust_odometry_apart_are_refused(kind, count):
    # at the end of a long loop, a few poses are said to be beside their way, by a corridor, which
    # the drift allows; then right closures follow. With a robust loss, the odometry into and out
    # of these pays less than closures do, and all closures fit
    rng, n = np.random.default_rng(0), 400
    phi = 2.0 * np.pi * np.arange(n + 60) / n
    truth = np.stack([30 * np.cos(phi), 30 * np.sin(phi), se2.wrap(phi + np.pi / 2)], -1)
    losses = Losses(odometry=Loss(kind, 3.0), closure=Loss(LossKind.HUBER, 2.0))
    graph = Graph(losses)
    graph.add_poses(truth)
    graph.fixed_poses[0] = True

    def edge(edge_kind, i, j, sigma, aside=0.0):
        noisy = se2.compose(se2.between(truth[i], truth[j]), sigma * rng.standard_normal(3))
        delta = se2.compose(noisy, np.array([0.0, aside, 0.0]))
        return graph.add_edge(edge_kind, i, j, delta, np.diag(sigma**-2.0))

    for k in range(n + 59):
        edge(EdgeKind.ODOMETRY, k, k + 1, np.array([0.003, 0.003, 0.002]))
    tight = np.array([0.01, 0.01, 0.004])
    first = n + 2
    wrong = [
        edge(EdgeKind.CLOSURE, first - n + 3 * k, first + 3 * k, tight, 2.4) for k in range(count)
    ]
    for k in range(first + 3 * count + 4, n + 60, 3):
        edge(EdgeKind.CLOSURE, k - n, k, tight)
    chosen = select_closures(graph, EXACT)
    assert_array_equal(chosen.edges[~chosen.accepted], wrong)
    assert graph.losses is losses


def test_selection_does_not_depend_on_where_the_map_lies_nor_on_the_start():
    one, other = laps(), laps(turned=2.0)
    for graph in (one, other):
        spoil(graph, WRONG)
    other.poses[1:] += np.random.default_rng(0).standard_normal((len(other.poses) - 1, 3))
    chosen, same = select_closures(one, EXACT), select_closures(other, EXACT)
    assert_array_equal(chosen.accepted, same.accepted)
    # expectation maximisation stops at a gain of 1e-6 per closure
    assert chosen.scale == pytest.approx(same.scale, rel=1e-2)


def test_a_wrong_closure_within_what_is_stated_is_refused_where_the_others_hold_better():
    # translation is stated ten times too uncertain, heading rightly: the wrong closure is off by
    # two sigmas of what is stated, and nothing but how well the others agree speaks against it
    source, rough = laps(), np.array([0.1, 0.1, 1.0])
    best = optimum(restated(source, rough))
    delta = se2.between(source.poses[71], source.poses[74]) + np.array([0.0, 1.0, 0.0])
    source.add_edge(EdgeKind.CLOSURE, 71, 74, delta, np.diag(SIGMA**-2))
    graph = restated(source, rough)
    chosen = select_closures(graph, EXACT)
    assert_array_equal(chosen.accepted, np.arange(len(chosen.edges)) < len(chosen.edges) - 1)
    assert_allclose(graph.poses, best, atol=1e-6)


@pytest.mark.parametrize('every', [10, 20])
def test_few_right_closures_stay_in(every):
    # 4 and 2 of them: too few to say how large errors are
    for seed in range(5):
        source = laps(seed)
        graph, e = Graph(), source.edges
        graph.add_poses(source.poses)
        graph.fixed_poses[0] = True
        closures = np.flatnonzero(e.kinds == FactorKind.CLOSURE)
        for k in [*np.flatnonzero(e.kinds == FactorKind.ODOMETRY), *closures[::every]]:
            kind = EdgeKind.CLOSURE if k in closures else EdgeKind.ODOMETRY
            graph.add_edge(kind, *e.nodes[k], e.measured[k], e.information[k])
        wrong = spoil(graph, WRONG[:4])
        chosen = select_closures(graph, EXACT)
        assert_array_equal(chosen.edges[~chosen.accepted], wrong)


def test_landmarks_are_trusted_and_losses_kept():
    losses = Losses(closure=Loss(LossKind.HUBER, 2.0), reflector=Loss(LossKind.CAUCHY, 3.0))
    graph, _, _ = loop_graph(losses=losses)
    wrong = spoil(graph, [(2, 9), (12, 20)])
    chosen = select_closures(graph, EXACT)
    assert_array_equal(chosen.edges[~chosen.accepted], wrong)
    assert graph.losses is losses
    assert graph.sightings.enabled.all()


def test_a_closure_that_alone_holds_two_parts_together_stays():
    graph = laps()
    graph.edges.enabled[80] = False  # the odometry from pose 80 to 81
    wrong = spoil(graph, WRONG[:4])
    chosen = select_closures(graph, EXACT)
    assert np.isinf(chosen.evidence).sum() == 1
    assert_array_equal(chosen.edges[~chosen.accepted], wrong)


def test_a_graph_without_closures_is_only_optimised():
    graph = laps(laps=1)
    chosen = select_closures(graph)
    assert len(chosen.edges) == 0
    assert graph.chi2() == pytest.approx(0.0, abs=1e-12)


def test_closures_that_take_turns_are_judged_a_bounded_number_of_times(monkeypatch):
    """Whoever is in is doubted, whoever is out comes back: it ends with nobody in doubt inside."""
    judged = []

    def turns(self):
        judged.append(int(self._accepted.sum()))
        self._left[:] = 2  # as many times as they like
        return np.ones(len(self._edges), np.bool_), np.where(self._accepted, -1e3, 1e3)

    monkeypatch.setattr(_Selector, '_evaluate_all', turns)
    selection = select_closures(laps())
    assert len(judged) == ROUNDS + 1
    assert judged[0] > 0
    assert not selection.accepted.any()
