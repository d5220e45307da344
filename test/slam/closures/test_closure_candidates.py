# SPDX-License-Identifier: Apache-2.0
"""How far around a keyframe is looked for, and in which submaps, follows from the graph."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import LoopClosure
from rlml_slam.slam.closures.closure_candidates import SIGMAS, candidates
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind

P = LoopClosure()


def way(sigma, sigma_turn=1e-6, steps=40):
    """A straight way of one metre a step, and its keyframes."""
    graph, keys = Graph(), []
    for k in range(steps):
        pose = np.array([float(k), 0.0, 0.0])
        keys.append(
            Keyframe(graph.add_pose(pose, k == 0), k + 1, pose, np.eye(3), None, None, k + 1)
        )
        if k:
            information = np.diag([sigma**-2, sigma**-2, sigma_turn**-2])
            graph.add_edge(EdgeKind.ODOMETRY, k - 1, k, [1.0, 0.0, 0.0], information)
    return graph, keys


def submaps(keys, *indices):
    return [KeyframeSubmap(keys[k], Submap(), 1, np.zeros(2)) for k in indices]


def test_sure_pose_is_searched_in_the_least_window_of_the_nearest():
    graph, keys = way(1e-3)
    among = submaps(keys, 5, 20, 25, 28, 30, 33)
    found = candidates(graph, keys[27], among, P)
    assert [c.m for c in found] == [among[k] for k in (3, 2, 4)]
    for c in found:
        assert (c.window, c.angle) == (P.search_window, P.search_angle)
        T = se2.compose(graph.poses[c.m.anchor.index], c.m.T_anchor_grid)
        np.testing.assert_allclose(c.guess, se2.between(T, graph.poses[27]), atol=1e-12)


def test_window_is_the_drift_since_the_submap():
    graph, keys = way(0.1, 0.005)
    (c,) = candidates(graph, keys[39], submaps(keys, 30), LoopClosure(max_distance=9.5))
    levers = np.arange(9)  # of the turns between keyframe 30 and 39
    sigma = np.hypot(np.sqrt(2.0) * 0.1, 0.005 * levers).sum()
    assert SIGMAS * sigma > P.search_window
    assert c.window == pytest.approx(SIGMAS * sigma, rel=1e-6)
    # the least turn is more than that of nine steps
    assert c.angle == P.search_angle


def test_window_has_an_end():
    graph, keys = way(1.0, 0.1)
    (c,) = candidates(graph, keys[39], submaps(keys, 30), LoopClosure(max_distance=9.5))
    assert (c.window, c.angle) == (P.max_search_window, P.max_search_angle)
    assert c.search_area > 16.0 * P.searched


def test_submap_beyond_the_plain_distance_is_tried_where_drift_reaches_it():
    for sigma, tried in ((1e-3, False), (0.2, True)):
        graph, keys = way(sigma)
        assert bool(candidates(graph, keys[39], submaps(keys, 27), P)) is tried


def test_others_in_reach_of_a_lost_robot_get_their_turns():
    graph, keys = way(0.3)
    among = submaps(keys, *range(28, 40, 2))
    tried = [{c.m.anchor.index for c in candidates(graph, key, among, P)} for key in keys[34:40]]
    assert all(len(t) == P.max_candidates + 1 for t in tried)
    assert set.union(*tried) == set(range(28, 40, 2))


def test_closed_loop_makes_the_search_small_again():
    graph, keys = way(0.3)
    among = submaps(keys, 33)
    wide = candidates(graph, keys[39], among, P)[0].window
    delta = se2.between(graph.poses[33], graph.poses[38])
    graph.add_edge(EdgeKind.CLOSURE, 33, 38, delta, np.diag([1e4, 1e4, 1e5]))
    assert P.search_window <= candidates(graph, keys[39], among, P)[0].window < 0.7 * wide
