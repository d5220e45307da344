# SPDX-License-Identifier: Apache-2.0
"""At the end, pending closures are judged by all closures together."""

from __future__ import annotations

import numpy as np
import pytest
from made_laps import LAP, SIGMA, true, two_laps

from rlml_slam import se2
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.closure_selection import Selection
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.slam.closures import pending_closures
from rlml_slam.slam.closures.closure_matching import Match
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.closures.loop_closer import LoopCloser
from rlml_slam.slam.closures.pending_closures import confirmed
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind

P = Parameters()
BEND = np.array([0.0, 0.0, 0.15])  # of the way before the second lap, where sigma is .005 rad


class NoNoise(np.random.Generator):
    """Draws nothing but zeros."""

    def __init__(self):
        super().__init__(np.random.PCG64(0))

    def standard_normal(self, size=None):
        return np.zeros(size)


def bent(rng):
    """Two laps; between them the robot turned further than the front end says, and surely."""
    steps, graph = two_laps(rng), Graph()
    deltas = steps.edges.measured.copy()
    deltas[LAP - 1] = se2.compose(deltas[LAP - 1], BEND)
    graph.add_pose(true(0), fixed=True)
    for k, delta in enumerate(deltas):
        graph.add_pose(se2.compose(graph.poses[-1], delta))
        graph.add_edge(EdgeKind.ODOMETRY, k, k + 1, delta, np.diag(SIGMA**-2))
    return graph


def matched(graph, i, j, rng, shift=(0.0, 0.0, 0.0)):
    """A weak match of keyframe j with the submap of keyframe i, off by ``shift``."""
    anchor, key = (Keyframe(k, k, graph.poses[k], np.eye(3), None, np.zeros(2), k) for k in (i, j))
    delta = se2.between(true(i), se2.compose(np.array(shift), true(j)))
    delta = se2.compose(delta, SIGMA * rng.standard_normal(3))
    place = KeyframeSubmap(anchor, Submap(), size=1, T_anchor_grid=np.zeros(3))
    return Match(
        place, key, delta, np.diag(SIGMA**-2), 0.5, 0.9, 0.5, 36.0, np.log(0.1),
        view_range=50.0, weak=True,
    )  # fmt: skip


def closer_of(graph, rng, nodes, shifts=None):
    closer = LoopCloser(P, OnlineSolver(graph))
    shifts = np.zeros((len(nodes), 3)) if shifts is None else shifts
    for (i, j), shift in zip(nodes, shifts, strict=True):
        closer._add([matched(graph, i, j, rng, shift)])
    return closer


NODES = [(k, k + LAP) for k in range(40, 70, 5)]


@pytest.mark.parametrize('seed', range(8))
def test_group_that_a_too_certain_graph_refuses_enters_at_the_end(seed):
    rng = np.random.default_rng(seed)
    graph = bent(rng)
    closer = closer_of(graph, rng, NODES)
    assert not [c for c in closer.records if c.accepted]  # at one viewpoint, by their range
    count, before = len(graph.edges.nodes), graph.poses.copy()
    assert closer.decide_pending()
    accepted = [c for c in closer.records if c.accepted]
    assert len(accepted) >= len(NODES) - 1
    assert len(graph.edges.nodes) == count + len(accepted)
    assert [c.number for c in accepted] == list(range(len(accepted)))
    assert closer.tried[True] == len(accepted)
    assert closer.tried[True] + closer.tried[False] == len(NODES)
    np.testing.assert_array_equal(graph.poses, before)  # the solver is to move them
    optimize(graph)
    last = se2.between(true(60), true(60 + LAP)) - se2.between(
        graph.poses[60], graph.poses[60 + LAP]
    )
    assert np.hypot(*last[:2]) < 0.2
    assert not closer.decide_pending()


def test_short_loops_that_fit_too_well_do_not_make_a_long_way_surer():
    """The bend is one of 3 sigma; that neighbours agree exactly changes nothing."""
    graph = bent(NoNoise())
    closer = closer_of(graph, NoNoise(), NODES)
    assert not [c for c in closer.records if c.accepted]
    assert closer.decide_pending()
    assert len([c for c in closer.records if c.accepted]) == len(NODES)


@pytest.mark.parametrize('seed', range(8))
def test_wrong_pending_closures_and_single_ones_stay_out_at_the_end(seed):
    rng = np.random.default_rng(seed)
    graph = bent(rng)
    shifts = rng.uniform((-3.0, -3.0, -0.5), (3.0, 3.0, 0.5), (len(NODES), 3))
    count = len(graph.edges.nodes)
    assert not closer_of(graph, rng, NODES, shifts).decide_pending()
    assert not closer_of(graph, rng, NODES[:1]).decide_pending()
    assert len(graph.edges.nodes) == count


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('is_cut', [False, True])
def test_group_that_contradicts_accepted_closures_stays_out(is_cut, seed):
    """Between two parts without motion a selection takes the largest group, untested."""
    rng = np.random.default_rng(seed)
    whole, graph = bent(rng), Graph()
    graph.add_pose(whole.poses[0], fixed=True)
    graph.add_poses(whole.poses[1:])
    for (i, j), delta in zip(whole.edges.nodes.tolist(), whole.edges.measured, strict=True):
        if i != LAP - 1 or not is_cut:
            graph.add_edge(EdgeKind.ODOMETRY, i, j, delta, np.diag(SIGMA**-2))
    for k in range(20, 23):
        edge = matched(graph, k, k + LAP, rng).edge(P.loop_closure)
        graph.add_edge(EdgeKind.CLOSURE, *edge)
    optimize(graph)
    wrong = [matched(graph, k, k + LAP, rng, (3.0, 0.0, 0.0)) for k in range(40, 48)]
    assert not any(confirmed(graph, ClosureRecords(), wrong, P))


@pytest.mark.parametrize('seed', [0, 2])
def test_group_that_contradicts_one_of_many_accepted_closures_stays_out(seed):
    """A group in rooms that look alike, where only one closure before says otherwise."""
    rng = np.random.default_rng(seed)
    graph = bent(rng)
    for k in [*range(20), 75]:
        edge = matched(graph, k, k + LAP, rng).edge(P.loop_closure)
        graph.add_edge(EdgeKind.CLOSURE, *edge)
    optimize(graph)
    wrong = [matched(graph, k, k + LAP, rng, (1.0, 0.0, 0.0)) for k in range(60, 66)]
    assert not any(confirmed(graph, ClosureRecords(), wrong, P))


@pytest.mark.parametrize(('accepted', 'right'), [(9, False), (10, True)])
def test_a_tenth_of_the_accepted_closures_may_be_refuted_in_any_case(monkeypatch, accepted, right):
    """One of them is, with the pending ones and without."""
    rng = np.random.default_rng(0)
    graph = bent(rng)
    for k in range(accepted):
        edge = matched(graph, k, k + LAP, rng).edge(P.loop_closure)
        graph.add_edge(EdgeKind.CLOSURE, *edge)

    def select(trial, *_, **__):
        edges = np.flatnonzero(trial.edges.kinds == FactorKind.CLOSURE)
        return Selection(edges, edges != edges[0], np.ones(len(edges)), 1.0)

    monkeypatch.setattr(pending_closures, 'select_closures', select)
    pending = [matched(graph, k, k + LAP, rng) for k in (60, 65)]
    assert confirmed(graph, ClosureRecords(), pending, P) == [right] * 2
