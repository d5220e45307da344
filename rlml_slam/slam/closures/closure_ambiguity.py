# SPDX-License-Identifier: Apache-2.0
"""Whether a place that a scan fits is told apart from those that it fits in other submaps.

Where pillars or doors repeat, a scan fits a submap that the robot never came back to: at the end
of what that one knows, where the places on either side are not in it. They are in others, tried
with the same scan. What fits there as well, is nearer to where the graph expects the keyframe, and
lies where the first submap knows nothing that would speak against it, puts the match in doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.path_bound import reach
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_matching import SECOND, Match, Tried
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe

APART = 0.5  # [m] at least between two places, as between those of one search
KNOWN = 0.5  # share of the end points in cells that a submap knows, where it can tell


def is_distinct(
    graph: Graph, key: Keyframe, points: Array, tried: Sequence[Tried], share: float
) -> list[Match | Closure]:
    """What was ``tried`` of a keyframe with ``points`` (n, 2), those in doubt rejected.

    A place fits as well with ``share`` of a match's score.
    """
    out = []
    for one in tried:
        found = one.result
        if isinstance(found, Match) and any(
            _is_rival(graph, key, points, other, found)
            for other in tried
            if other is not one and other.result.score >= share * found.score
        ):
            found = found.closure(SECOND)
        out.append(found)
    return out


def _is_rival(graph: Graph, key: Keyframe, points: Array, other: Tried, found: Match) -> bool:
    """Whether a place in another submap is likelier than the one that was found."""
    m, expected = other.candidate.m, graph.poses[key.index]
    grid = se2.compose(graph.poses[found.m.anchor.index], found.m.T_anchor_grid)
    here = se2.compose(grid, found.T_grid_key)
    places = se2.compose(se2.compose(graph.poses[m.anchor.index], m.T_anchor_grid), other.places)
    nearer = np.hypot(*(places - expected)[:, :2].T) < math.dist(here[:2], expected[:2])
    rivals = places[nearer & (np.hypot(*(places - here)[:, :2].T) > APART)]
    if not len(rivals) or not _is_of_one_pass(graph, key, other, found):
        return False
    there = [se2.transform(se2.between(grid, place), points) for place in rivals]
    return any(found.m.submap.knows(seen) < KNOWN for seen in there)


def _is_of_one_pass(graph: Graph, key: Keyframe, other: Tried, found: Match) -> bool:
    """Whether the submaps know of each other's place more than the keyframe does.

    The robot's newest submaps show where it is now, wherever that is of the older ones.
    """
    anchor = np.array([other.candidate.m.anchor.index])
    between = float(reach(graph, found.m.anchor.index, anchor)[0, 0])
    return between < float(reach(graph, key.index, anchor)[0, 0])
