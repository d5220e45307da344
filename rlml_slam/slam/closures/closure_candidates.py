# SPDX-License-Identifier: Apache-2.0
"""With which submaps a keyframe may close a loop, and how far around to search in each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.path_bound import reach
from rlml_slam.params import LoopClosure
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.keyframes import Keyframe

SIGMAS = 3.0  # how far off a keyframe is looked for: the bound holds all but the ends of the tails


@dataclass(frozen=True)
class Candidate:
    """A submap in which a keyframe may be at ``guess`` (3,), its grid's frame.

    Searched is the square of half width ``window`` [m] around it, turned by up to ``angle`` [rad].
    """

    m: KeyframeSubmap
    guess: Array
    window: float
    angle: float

    @property
    def searched(self) -> float:
        """Area [m²] of the search, were it made at all headings: of as many places as it is."""
        return (2.0 * self.window) ** 2 * self.angle / math.pi


def candidates(
    graph: Graph, key: Keyframe, among: Sequence[KeyframeSubmap], p: LoopClosure
) -> list[Candidate]:
    """Those ``among`` submaps where the keyframe may be, the nearest first.

    How far it may be off from each, the graph bounds (graph/reach.py). Where that is more than
    the least window, there may be more submaps in reach than are tried at a time: of the others,
    that one is tried as well whose last turn is longest ago.
    """
    pose = graph.poses[key.index]
    if not among:
        return []
    bases = graph.poses[[m.anchor.index for m in among]]
    grids = se2.compose(bases, np.array([m.T_anchor_grid for m in among]))
    centres = se2.transform(grids, np.array([m.centre for m in among])[:, None])[:, 0]
    gaps = np.hypot(*(centres - pose[:2]).T).tolist()
    order = np.argsort(gaps, kind='stable').tolist()
    order = [k for k in order if gaps[k] < p.max_distance + p.max_search_window - p.search_window]
    if not order:
        return []
    anchors = np.array([among[k].anchor.index for k in order], dtype=np.int64)
    off = SIGMAS * reach(graph, key.index, anchors)
    windows = np.clip(off[:, 0], p.search_window, p.max_search_window).tolist()
    angles = np.clip(off[:, 1], p.search_angle, p.max_search_angle).tolist()
    found = [
        (among[k], window, angle)
        for k, window, angle in zip(order, windows, angles, strict=True)
        if gaps[k] < p.max_distance + window - p.search_window
    ]
    first, others = found[: p.max_candidates], found[p.max_candidates :]
    lost = [c for c in others if c[1] > p.search_window]
    chosen = first + sorted(lost, key=lambda c: c[0].turn)[:1]
    for m, _, _ in chosen:
        m.turn = key.stamp
    return [
        Candidate(m, se2.between(_grid(graph, m), pose), window, angle)
        for m, window, angle in chosen
    ]


def _grid(graph: Graph, m: KeyframeSubmap) -> Array:
    return se2.compose(graph.poses[m.anchor.index], m.T_anchor_grid)
