# SPDX-License-Identifier: Apache-2.0
"""After a large drift a scan is searched in a local map; a weak match needs others that agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_laps import COV, LAP, SIGMA, true, two_laps
from made_worlds import TinyWorld, cast, polygon

from rlml_slam import se2
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.inlier_evidence import uniform
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.closure_consistency import is_consistent
from rlml_slam.slam.closures.closure_matching import ClosureMatcher, Match
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.closures.local_map import MAX_DRIFT, Surroundings, local_map
from rlml_slam.slam.closures.loop_closer import MAX_PENDING, PENDING, LoopCloser
from rlml_slam.slam.closures.weak_match import OUTSCORED, keep_best
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind

P = Parameters()
LEAST = P.loop_closure.min_score
WINDOW = 4.0  # [m] wider than the smallest one


def hall(seed):
    """A hall of 16 by 10 m whose furniture stands at random."""
    rng = np.random.default_rng(seed)
    walls = [polygon((-8.0, -5.0), (8.0, -5.0), (8.0, 5.0), (-8.0, 5.0))]
    for x in np.linspace(-7.0, 7.0, 8):
        for side in (-1.0, 1.0):
            centre = np.array([x + rng.uniform(-0.5, 0.5), side * rng.uniform(2.2, 4.2)])
            size, turn = rng.uniform(0.2, 0.7, 2), rng.uniform(0.0, np.pi)
            corners = size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            walls.append(polygon(*(centre + corners @ se2.rotation(turn).T)))
    return TinyWorld(np.vstack(walls), np.zeros((0, 2)))


def seen(world, pose, beams=720):
    """End points (n, 2) in base of a laser that looks ahead: 180 degrees."""
    ranges = cast(world.walls, pose, beams)
    angles = -np.pi + np.arange(beams) * (2.0 * np.pi / beams)
    hit = np.isfinite(ranges) & (np.abs(angles) <= np.pi / 2.0)
    return ranges[hit, None] * np.stack([np.cos(angles[hit]), np.sin(angles[hit])], -1)


def mapped(world, headings, sigma=0.01):
    """Graph, keyframes and one submap for each heading, all seen from the middle of the hall."""
    graph, keys, submaps = Graph(), [], []
    for k, heading in enumerate(headings):
        pose = np.array([0.0, 0.0, heading])
        index = graph.add_pose(pose, fixed=k == 0)
        if k:
            delta = se2.between(graph.poses[k - 1], pose)
            graph.add_edge(EdgeKind.SCAN, k - 1, k, delta, np.eye(3) / sigma**2)
        keys.append(Keyframe(index, index, pose, np.eye(3), None, np.zeros(2), index))
        submap = Submap()
        for x in np.linspace(-1.0, 1.0, 5):
            T = np.array([x, 0.0, 0.0])
            points = seen(world, se2.compose(pose, T))
            for _ in range(3):
                submap.insert(se2.transform(T, points), T[:2])
        submap.complete()
        submaps.append(KeyframeSubmap(keys[-1], submap, 5, T_anchor_grid=np.zeros(3)))
    return graph, keys, submaps


def test_local_map_leaves_known_cells_and_fills_in_what_neighbours_know():
    graph, _, (m, other) = mapped(hall(0), (0.0, np.pi))
    grid = local_map(m, Surroundings(graph, [m, other]))
    known = m.submap.values != 0
    assert grid.corner == m.submap.corner
    assert grid.values.shape == known.shape
    assert (grid.values[known] == m.submap.values[known]).all()
    filled = (grid.values != 0) & ~known
    assert filled.sum() > 100
    i, j = np.nonzero(filled)
    at = (np.stack([j, i], -1) + np.array(grid.corner) + 0.5) * grid.resolution
    T = se2.between(other.grid_pose(graph.poses), m.grid_pose(graph.poses))
    assert other.submap.knows(se2.transform(T, at)) == 1.0
    # and it is a copy
    assert not (m.submap.values != 0)[filled].any()


@pytest.mark.parametrize('sigma', [0.1 * MAX_DRIFT, 2.0 * MAX_DRIFT])
def test_submap_whose_place_is_uncertain_is_no_neighbour(sigma):
    graph, _, submaps = mapped(hall(1), (0.0, np.pi), sigma)
    grid = local_map(submaps[0], Surroundings(graph, submaps))
    same = np.array_equal(grid.values, submaps[0].submap.values)
    assert same is (sigma > MAX_DRIFT)


def searched(world, place, model, around):
    """Match of a scan of ``world`` at ``place`` (3,) with the first submap of a model, or not."""
    graph, _, submaps = model
    key = Keyframe(9, 9, place, np.eye(3), None, np.zeros(2), 9)
    guess = se2.compose(place, np.array([0.9, -0.7, 0.1]))
    candidate = Candidate(submaps[0], guess, WINDOW, 0.5)
    surroundings = Surroundings(graph, submaps) if around else None
    return ClosureMatcher(P).match(candidate, key, seen(world, place, 360), surroundings).result


def test_scan_on_the_way_back_matches_the_local_map_and_not_the_submap():
    """Of one way each submap knows one half; the scan across sees both."""
    across = np.array([0.2, 0.1, np.pi / 2.0])
    for seed in range(4):
        model = mapped(hall(seed), (0.0, np.pi))
        assert not isinstance(searched(hall(seed), across, model, False), Match)
        found = searched(hall(seed), across, model, True)
        assert isinstance(found, Match)
        off = se2.between(across, found.T_grid_key)
        assert np.hypot(*off[:2]) < 0.1
        assert abs(off[2]) < 0.02


def test_another_hall_does_not_match_the_local_map():
    across = np.array([0.2, 0.1, np.pi / 2.0])
    for seed in range(4):
        model = mapped(hall(seed), (0.0, np.pi))
        found = searched(hall(seed + 100), across, model, True)
        assert not isinstance(found, Match) or found.weak


# --- weak matches in the graph ------------------------------------------------------------------

WRONG = uniform(36.0)
WEAK = np.log(0.1)  # prior log odds of the weakest matches


def entered(graph, nodes, shifts, rng, log_odds=WEAK):
    """Which closures (k, 2) may enter that are off by ``shifts`` (k, 3) and by their noise."""
    nodes = np.array(nodes)
    off = se2.compose(np.broadcast_to(shifts, (len(nodes), 3)), true(nodes[:, 1]))
    deltas = se2.between(true(nodes[:, 0]), off)
    deltas = se2.compose(deltas, SIGMA * rng.standard_normal(deltas.shape))
    covs = np.broadcast_to(COV, (len(nodes), 3, 3))
    weak = log_odds < 0.0
    return is_consistent(OnlineSolver(graph), nodes, deltas, covs, WRONG, log_odds, 1.0, weak)


@pytest.mark.parametrize('seed', range(8))
def test_weak_matches_enter_together_and_never_alone(seed):
    rng = np.random.default_rng(seed)
    graph, shift = two_laps(rng), np.zeros(3)
    nodes = [(k, k + LAP) for k in range(5, 70, 5)]
    assert entered(graph, nodes[:1], shift, rng, 0.0).all()
    assert not entered(graph, nodes[:1], shift, rng).any()
    # two submaps at one viewpoint are no support
    assert not entered(graph, [(5, 5 + LAP), (6, 5 + LAP)], shift, rng).any()
    assert entered(graph, nodes, shift, rng).mean() > 0.8


@pytest.mark.parametrize('seed', range(8))
def test_wrong_weak_matches_do_not_enter(seed):
    rng = np.random.default_rng(seed)
    graph, nodes = two_laps(rng), [(k, k + LAP) for k in range(5, 70, 5)]
    shifts = rng.uniform((-3.0, -3.0, -0.5), (3.0, 3.0, 0.5), (len(nodes), 3))
    assert not entered(graph, nodes, shifts, rng).any()


def test_of_the_weak_matches_of_a_keyframe_the_best_one_is_kept():
    key = Keyframe(9, 9, np.zeros(3), np.eye(3), None, None, 9)
    place = KeyframeSubmap(key, Submap())

    def made(score, log_odds):
        return Match(
            place,
            key,
            np.zeros(3),
            np.eye(3),
            score,
            1.0,
            0.5,
            36.0,
            log_odds,
            weak=log_odds < 0.0,
        )

    weak, better, strong = made(0.48, -1.0), made(0.5, -0.5), made(LEAST, 0.0)
    out = keep_best([weak, strong, better])
    assert out[1] is strong
    assert out[2] is better
    assert out[0].why == OUTSCORED


def matched(graph, i, j, rng, shift=(0.0, 0.0, 0.0), weak=True):
    """A match of keyframe j with the submap of keyframe i, off by ``shift`` and its noise."""
    anchor, key = (Keyframe(k, k, graph.poses[k], np.eye(3), None, np.zeros(2), k) for k in (i, j))
    delta = se2.between(true(i), se2.compose(np.array(shift), true(j)))
    delta = se2.compose(delta, SIGMA * rng.standard_normal(3))
    place = KeyframeSubmap(anchor, Submap(), size=1, T_anchor_grid=np.zeros(3))
    return Match(
        place, key, delta, np.diag(SIGMA**-2), 0.5, 0.9, 0.5, 36.0, WEAK if weak else 0.0,
        view_range=1.0, weak=weak,
    )  # fmt: skip


def test_weak_matches_wait_until_others_agree():
    rng = np.random.default_rng(0)
    graph = two_laps(rng)
    closer = LoopCloser(P, OnlineSolver(graph))
    first = closer._add([matched(graph, 5, 5 + LAP, rng)])
    assert [(c.accepted, c.why) for c in first] == [(False, PENDING)]
    accepted = {c.j for k in range(10, 70, 5)
                for c in closer._add([matched(graph, k, k + LAP, rng)]) if c.accepted}  # fmt: skip
    assert 5 + LAP in accepted
    assert len(accepted) > 8
    assert all(c.j != 5 + LAP or c.accepted for c in closer.records)  # its rejection is gone


def test_weak_matches_push_no_strong_one_out():
    rng = np.random.default_rng(1)
    graph = two_laps(rng)
    closer = LoopCloser(P, OnlineSolver(graph))
    far = (40.0, -30.0, 2.0)  # nothing agrees with it
    closer._add([matched(graph, 5, 5 + LAP, rng, far, weak=False)])
    for k in range(MAX_PENDING + 10):
        shift = rng.uniform((-30.0, -30.0, -3.0), (30.0, 30.0, 3.0))
        closer._add([matched(graph, k, k + LAP, rng, shift)])
    assert len(closer._pending) == MAX_PENDING
    assert [c.key.index for c in closer._pending if not c.weak] == [5 + LAP]


@pytest.mark.parametrize(
    ('window', 'is_wide'), [(P.loop_closure.search_window, False), (WINDOW, True)]
)
def test_match_of_a_search_wider_than_the_smallest_one_is_wide(window, is_wide):
    world, place = hall(0), np.array([0.2, 0.1, 0.1])
    _, _, submaps = mapped(world, (0.0,))
    key = Keyframe(9, 9, place, np.eye(3), None, np.zeros(2), 9)
    candidate = Candidate(submaps[0], place, window, P.loop_closure.search_angle)
    found = ClosureMatcher(P).match(candidate, key, seen(world, place, 360)).result
    assert isinstance(found, Match)
    assert found.wide is is_wide
    assert not found.weak


def test_wide_match_waits_as_a_weak_one_does():
    """Where the place is uncertain, one room fits as well as the next one."""
    for wide in (False, True):
        rng = np.random.default_rng(0)
        graph = two_laps(rng)
        closer = LoopCloser(P, OnlineSolver(graph))
        first = replace(matched(graph, 5, 5 + LAP, rng, weak=False), wide=wide)
        assert [c.accepted for c in closer._add([first])] == [not wide]
        later = [replace(matched(graph, k, k + LAP, rng, weak=False), wide=True) for k in (30, 55)]
        assert 5 + LAP in {c.j for c in closer.records if c.accepted} | {
            c.j for match in later for c in closer._add([match]) if c.accepted
        }
