# SPDX-License-Identifier: Apache-2.0
"""With which submaps a keyframe may close a loop, and how far around to search in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.graph import Graph
from rlml_slam.params import LoopClosure
from rlml_slam.rlml.key_submap import KeySubmap
from rlml_slam.rlml.keyframes import Keyframe
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Candidate:
    """A submap in which a keyframe may be at ``guess`` (3,), its grid's frame.

    Searched is the square of half width ``window`` [m] around it, turned by up to ``angle`` [rad].
    """

    m: KeySubmap
    guess: Array
    window: float
    angle: float


def candidates(
    graph: Graph, key: Keyframe, among: Sequence[KeySubmap], p: LoopClosure
) -> list[Candidate]:
    """Those ``among`` submaps whose centres are near the keyframe, the nearest first."""
    pose = graph.poses[key.index]
    near = []
    for k, m in enumerate(among):
        grid = se2.compose(graph.poses[m.anchor.index], m.T_anchor_grid)
        distance = float(np.linalg.norm(se2.transform(grid, m.centre[None])[0] - pose[:2]))
        if distance < p.max_distance:
            guess = se2.between(grid, pose)
            near.append((distance, k, Candidate(m, guess, p.search_window, p.search_angle)))
    return [candidate for _, _, candidate in sorted(near, key=lambda n: n[:2])[: p.candidates]]
