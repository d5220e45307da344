# SPDX-License-Identifier: Apache-2.0
"""Rejection of matches with an equally good match in another submap, closer to the estimate.

Where structures repeat (pillars, doors), a scan also fits at the border of a submap that the robot
did not revisit, where that submap lacks the neighbouring structures. Other submaps, searched with
the same scan, contain them. A match is ambiguous if another submap has a pose that fits as well,
that is closer to where the graph expects the keyframe, and that lies where the submap of the match
is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rlml_slam import se2
from rlml_slam.graph import Graph, path_bound
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_matching import AMBIGUOUS, Match, SearchResult
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe

MIN_SEPARATION = 0.5  # [m] between two distinct poses, as between those of one search
KNOWN_SHARE = 0.5  # of the end points in known cells, for a submap to contain a place


def reject_ambiguous(
    graph: Graph, key: Keyframe, points: Array, results: Sequence[SearchResult], ratio: float
) -> list[Match | Closure]:
    """Results for a keyframe with ``points`` (n, 2), ambiguous matches replaced by rejections.

    Another pose fits as well if its score is at least ``ratio`` of the match's.
    """
    out = []
    for one in results:
        found = one.result
        if isinstance(found, Match) and any(
            _is_better_placed(graph, key, points, other, found)
            for other in results
            if other is not one and other.result.score >= ratio * found.score
        ):
            found = found.closure(AMBIGUOUS)
        out.append(found)
    return out


def _is_better_placed(
    graph: Graph, key: Keyframe, points: Array, other: SearchResult, found: Match
) -> bool:
    """Whether a pose in another submap is more likely than the match."""
    expected = graph.poses[key.index]
    grid = found.m.grid_pose(graph.poses)
    matched = se2.compose(grid, found.T_grid_key)
    poses = se2.compose(other.candidate.m.grid_pose(graph.poses), other.poses)
    nearer = np.hypot(*(poses - expected)[:, :2].T) < math.dist(matched[:2], expected[:2])
    distinct = np.hypot(*(poses - matched)[:, :2].T) > MIN_SEPARATION
    alternatives = poses[nearer & distinct]
    if not len(alternatives) or not _are_of_one_pass(graph, key, other, found):
        return False
    seen = [se2.transform(se2.between(grid, pose), points) for pose in alternatives]
    return any(found.m.submap.knows(p) < KNOWN_SHARE for p in seen)


def _are_of_one_pass(graph: Graph, key: Keyframe, other: SearchResult, found: Match) -> bool:
    """Whether the two submaps are better known to each other than to the keyframe.

    The robot's newest submaps surround it wherever it is, so they are no alternatives.
    """
    anchor = np.array([other.candidate.m.anchor.index])
    between = float(path_bound(graph, found.m.anchor.index, anchor)[0, 0])
    return between < float(path_bound(graph, key.index, anchor)[0, 0])
