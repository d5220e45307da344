# SPDX-License-Identifier: Apache-2.0
"""A match far from where a scan is expected must not be one of several places alike."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.slam.closures.closure_ambiguity import reject_ambiguous
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.closure_matching import AMBIGUOUS, Match, SearchResult
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind

SHARE, SCORE = 0.95, 0.7
OLD, BESIDE, NEWEST, KEY = range(4)
# along a corridor; the way back to it was long, and what it left is not sure
PLACES = [(0.0, 0.0, 0.0), (12.0, 0.0, 0.0), (12.5, 0.0, 0.0), (13.0, 0.0, 0.0)]
SIGMAS = {(OLD, BESIDE): 0.05, (BESIDE, NEWEST): 2.0, (NEWEST, KEY): 0.05}
WALLS = np.concatenate(
    [np.column_stack([np.arange(-5.0, 5.0, 0.05), np.full(200, y)]) for y in (-1.0, 1.0)]
)
WRONG = np.array([1.0, 0.0, 0.0])  # in the oldest submap, 12 m from where the robot is


def tried_alike(rival, at, score=SCORE):
    """What is left of a match in the oldest submap, where another one fits ``at`` (3,) as well."""
    graph = Graph()
    keys = []
    for place in PLACES:
        pose = np.array(place)
        index = graph.add_pose(pose)
        keys.append(Keyframe(index, index, pose, np.eye(3), None, None, index))
    for (i, j), sigma in SIGMAS.items():
        delta = se2.between(graph.poses[i], graph.poses[j])
        graph.add_edge(EdgeKind.ODOMETRY, i, j, delta, np.eye(3) / sigma**2)
    maps = [KeyframeSubmap(key, Submap(), 1, T_anchor_grid=np.zeros(3)) for key in keys[:KEY]]
    maps[OLD].submap.insert(WALLS, np.zeros(2))
    maps[OLD].submap.complete()
    found = Match(maps[OLD], keys[KEY], WRONG, np.eye(3), SCORE, 1.0, np.nan, 36.0, view_range=2.0)
    expected = Candidate(maps[OLD], np.array(PLACES[KEY]), 12.0, 1.5)
    fits = SearchResult(expected, found, WRONG[None])
    doubt = Closure(rival, KEY, np.zeros(3), score, -1, AMBIGUOUS)
    place = se2.between(graph.poses[rival], np.array(at))
    others = SearchResult(Candidate(maps[rival], np.zeros(3), 12.0, 1.5), doubt, place[None])
    out = reject_ambiguous(graph, keys[KEY], WALLS, [fits, others], SHARE)
    assert out[1] is doubt
    return out[0]


def test_place_alike_beside_the_submap_puts_a_match_in_doubt():
    assert tried_alike(BESIDE, (12.5, 0.0, 0.0)).why == AMBIGUOUS


@pytest.mark.parametrize(
    ('rival', 'at', 'score'),
    [
        (BESIDE, (12.5, 0.0, 0.0), 0.9 * SHARE * SCORE),  # fits less well
        (BESIDE, (30.0, 0.0, 0.0), SCORE),  # farther from where the robot is expected
        (BESIDE, (2.0, 0.0, 0.0), SCORE),  # the submap knows better: it was searched there
        (BESIDE, (1.2, 0.0, 0.0), SCORE),  # the same place
        (NEWEST, (13.0, 0.0, 0.0), SCORE),  # where the robot is now, wherever that is
    ],
)
def test_what_is_no_other_place_puts_none_in_doubt(rival, at, score):
    assert isinstance(tried_alike(rival, at, score), Match)
