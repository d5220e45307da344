# SPDX-License-Identifier: Apache-2.0
"""A closure enters where the graph expects it, or with others that agree, seen from apart."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_laps import COV, LAP, true, two_laps
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.inlier_evidence import uniform
from rlml_slam.graph.robust.spanning_forest import SpanningForest
from rlml_slam.slam.closures.closure_consistency import (
    REPEATED_WRONG,
    _RelativeCovariance,
    is_consistent,
)
from rlml_slam.types import EdgeKind

WRONG = uniform(6.0)


@pytest.fixture(scope='module')
def graph():
    return two_laps(np.random.default_rng(3))


def tried(graph, ends, shift=(0.0, 0.0, 0.0), view_range=0.0, log_odds=0.0):
    """Whether closures (i, j) may enter which say that the true places are off by a shift."""
    nodes = np.array(ends)
    off = se2.compose(np.asarray(shift, dtype=np.float64), true(nodes[:, 1]))
    deltas = se2.between(true(nodes[:, 0]), off)
    covs = np.broadcast_to(COV, (len(nodes), 3, 3))
    weak = np.asarray(log_odds) < 0.0
    return is_consistent(
        OnlineSolver(graph), nodes, deltas, covs, WRONG, log_odds, view_range, weak
    )


def sure(graph):
    """The same graph after many closures: sharp all over."""
    out = Graph()
    out.add_poses(true(np.arange(2 * LAP)))
    out.fixed_poses[0] = True
    e = graph.edges
    for (i, j), information in zip(e.nodes, e.information, strict=True):
        out.add_edge(EdgeKind.ODOMETRY, i, j, se2.between(true(i), true(j)), information)
    for k in range(LAP):
        delta = se2.between(true(k), true(k + LAP))
        out.add_edge(EdgeKind.CLOSURE, k, k + LAP, delta, np.linalg.inv(COV))
    return out


def test_covariance_of_where_a_pose_is_adds_up_along_a_chain(graph):
    i, j = np.array([3, 90, 7, 0]), np.array([100, 20, 8, 159])
    covs = _RelativeCovariance(OnlineSolver(graph), np.unique([i, j])).covs(i, j)
    chain = SpanningForest(graph, np.arange(len(graph.edges))).motion(i, j)[1]
    assert_allclose(covs, chain, rtol=1e-6, atol=1e-12)


def test_closure_that_the_graph_expects_enters_alone(graph):
    assert tried(graph, [(5, 5 + LAP)]).all()
    assert tried(sure(graph), [(5, 5 + LAP)]).all()


def test_surer_the_graph_the_nearer_it_must_be(graph):
    off = (0.4, 0.0, 0.0)
    assert tried(graph, [(5, 5 + LAP)], off).all()
    assert not tried(sure(graph), [(5, 5 + LAP)], off).any()


def test_far_one_waits_until_others_from_apart_agree(graph):
    far = (2.0, 0.0, 0.0)
    sharp = sure(graph)
    ends = [(k, k + LAP) for k in range(5, 70, 5)]
    assert not tried(sharp, ends[:1], far).any()
    assert not tried(sharp, ends[:3], far).any()
    assert tried(sharp, ends, far).all()


def test_more_of_them_are_asked_where_the_graph_is_surer(graph):
    ends = [(k, k + LAP) for k in range(5, 70, 5)]
    far = (2.0, 0.0, 0.0)

    def asked(one):
        return next(n for n in range(1, len(ends) + 1) if tried(one, ends[:n], far).any())

    assert 1 < asked(graph) < asked(sure(graph))


def test_views_from_one_place_count_as_one(graph):
    """However many there are, and of however many submaps."""
    far = (2.0, 0.0, 0.0)
    ends = [(i, j + LAP) for i in range(5, 9) for j in (5, 6, 7)]
    assert not tried(sure(graph), ends, far).any()


def test_views_of_the_same_walls_count_as_one(graph):
    """In a long corridor one sees the same for longer than between desks."""
    far, sharp = (2.0, 0.0, 0.0), sure(graph)
    ends = [(k, k + LAP) for k in range(5, 70, 5)]
    assert tried(sharp, ends, far, view_range=1.0).all()
    assert not tried(sharp, ends, far, view_range=5.0).any()


def test_weak_matches_support_others_less(graph):
    ends, weakest = [(k, k + LAP) for k in range(5, 70, 5)], math.log(REPEATED_WRONG)
    odds = np.zeros(len(ends))
    assert tried(graph, ends[:2], log_odds=[weakest, 0.0]).any()
    assert not tried(graph, ends[:2], log_odds=[weakest, 0.1 * weakest]).any()
    assert not tried(graph, ends[:2], log_odds=weakest).any()
    odds[:6] = weakest
    assert tried(graph, ends, log_odds=odds).all()


def test_of_one_viewpoint_the_best_match_counts(graph):
    ends = [(5, 5 + LAP), (25, 25 + LAP), (26, 25 + LAP), (45, 45 + LAP)]
    weakest = math.log(REPEATED_WRONG)
    least = 0.001 * weakest
    assert tried(graph, ends, log_odds=[0.5 * weakest, weakest, 0.6 * weakest, least]).all()
    assert tried(graph, ends, log_odds=[0.5 * weakest, 0.6 * weakest, weakest, least]).any()
    assert not tried(graph, ends, log_odds=[0.5 * weakest, weakest, weakest, least]).any()


def test_matches_that_are_weaker_never_harm(graph):
    weakest = math.log(REPEATED_WRONG)
    strong = [(20, 20 + LAP), (30, 30 + LAP)]
    for shift in ((0.7, 0.0, 0.0), (0.85, 0.0, 0.0), (1.0, 0.0, 0.0)):
        for count in (1, 2):
            before = tried(graph, strong[:count], shift, 10.0)
            both = tried(
                graph, [(16, 16 + LAP), *strong[:count]], shift, 10.0, [weakest] + count * [0.0]
            )
            assert (both[1:] >= before).all()


def test_odds_of_what_proposed_a_match_are_its_own(graph):
    far, sharp = (2.0, 0.0, 0.0), sure(graph)
    ends = [(5, 5 + LAP), (25, 25 + LAP)]
    assert tried(sharp, ends, far, log_odds=[100.0, 0.0]).tolist() == [True, False]


def test_two_matches_of_a_wide_search_from_nearly_one_viewpoint_are_not_enough(graph):
    """Where rooms repeat, the next scan, half a median range on, fits in the same wrong room."""
    wide, ends = -1e-12, [(5, 5 + LAP), (15, 15 + LAP)]
    travel = math.dist(true(15)[:2], true(5)[:2])
    assert not tried(graph, ends, view_range=2.0 * travel, log_odds=wide).any()
    assert tried(graph, ends, view_range=0.9 * travel, log_odds=wide).all()


def test_weaker_matches_need_more_viewpoints(graph):
    ends = [(k, k + LAP) for k in range(5, 70, 5)]

    def asked(odds):
        return next(
            n for n in range(1, len(ends) + 1) if tried(graph, ends[:n], log_odds=odds).any()
        )

    asked_of = [asked(share * math.log(REPEATED_WRONG)) for share in (0.1, 0.6, 1.0)]
    assert asked_of == [3, 4, 9]


def test_wrong_ones_that_disagree_help_no_one(graph):
    rng = np.random.default_rng(0)
    nodes = np.array([(k, k + LAP) for k in range(5, 70, 5)])
    shift = np.column_stack([rng.uniform(-3.0, 3.0, (len(nodes), 2)), np.zeros(len(nodes))])
    shift[:, :2] += 2.0 * np.sign(shift[:, :2])
    deltas = se2.between(true(nodes[:, 0]), se2.compose(shift, true(nodes[:, 1])))
    covs = np.broadcast_to(COV, (len(nodes), 3, 3))
    assert not is_consistent(OnlineSolver(sure(graph)), nodes, deltas, covs, WRONG).any()


def test_nothing_depends_on_the_order_of_submaps_or_on_the_frame(graph):
    ends = [(k, k + LAP) for k in range(5, 40, 5)]
    far = (0.9, 0.0, 0.0)
    flags = tried(graph, ends, far)
    moved = Graph()
    moved.add_poses(se2.compose(np.array([3.0, -2.0, 1.1]), graph.poses))
    moved.fixed_poses[0] = True
    e = graph.edges
    moved.add_edges(EdgeKind.ODOMETRY, e.nodes, e.measured, e.information)
    assert (tried(moved, ends, far) == flags).all()
    assert (tried(graph, ends[::-1], far) == flags[::-1]).all()
