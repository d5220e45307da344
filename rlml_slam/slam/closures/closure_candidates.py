# SPDX-License-Identifier: Apache-2.0
"""Candidate submaps for loop closures of a keyframe, and the search window in each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.graph import Graph, path_bound
from rlml_slam.params import LoopClosure
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.keyframes import Keyframe

SIGMAS = 3.0  # half width of the search window, in standard deviations of the drift
PROPOSED = 1.0, 0.2  # [m], [rad] half width around a pose that was proposed
NEAREST = 3  # submaps that are tried there


@dataclass(frozen=True)
class Candidate:
    """Submap to search for a keyframe expected at ``guess`` (3,) of the grid frame.

    The search window is the square of half width ``window`` [m] around it, and headings that
    differ by up to ``angle`` [rad].
    """

    m: KeyframeSubmap
    guess: Array
    window: float
    angle: float

    @property
    def search_area(self) -> float:
        """Area [m²] at all headings that has the volume of the search window."""
        return (2.0 * self.window) ** 2 * self.angle / math.pi


def candidates(
    graph: Graph, key: Keyframe, among: Sequence[KeyframeSubmap], p: LoopClosure
) -> list[Candidate]:
    """Submaps ``among`` which the keyframe may be, the nearest first.

    The drift relative to each is bounded by the graph (graph/robust/path_bound.py). With a large
    drift more submaps are in range than are searched for one keyframe: the one of them whose last
    search is longest ago is added.
    """
    pose = graph.poses[key.index]
    if not among:
        return []
    gaps = _distances(graph, among, pose)
    order = np.argsort(gaps, kind='stable').tolist()
    order = [k for k in order if gaps[k] < p.max_distance + p.max_search_window - p.search_window]
    if not order:
        return []
    anchors = np.array([among[k].anchor.index for k in order], dtype=np.int64)
    drift = SIGMAS * path_bound(graph, key.index, anchors)
    windows = np.clip(drift[:, 0], p.search_window, p.max_search_window).tolist()
    angles = np.clip(drift[:, 1], p.search_angle, p.max_search_angle).tolist()
    found = [
        (among[k], window, angle)
        for k, window, angle in zip(order, windows, angles, strict=True)
        if gaps[k] < p.max_distance + window - p.search_window
    ]
    first, others = found[: p.max_candidates], found[p.max_candidates :]
    wide = [c for c in others if c[1] > p.search_window]
    chosen = first + sorted(wide, key=lambda c: c[0].last_search)[:1]
    for m, _, _ in chosen:
        m.last_search = key.stamp
    return [
        Candidate(m, se2.between(m.grid_pose(graph.poses), pose), window, angle)
        for m, window, angle in chosen
    ]


def candidates_at(
    graph: Graph, among: Sequence[KeyframeSubmap], T_map_key: Array, p: LoopClosure
) -> list[Candidate]:
    """Submaps ``among`` which a keyframe proposed at a pose (3,) may be, the nearest first."""
    if not among:
        return []
    gaps = _distances(graph, among, T_map_key)
    order = [k for k in np.argsort(gaps, kind='stable').tolist() if gaps[k] < p.max_distance]
    return [
        Candidate(among[k], se2.between(among[k].grid_pose(graph.poses), T_map_key), *PROPOSED)
        for k in order[:NEAREST]
    ]


def _distances(graph: Graph, among: Sequence[KeyframeSubmap], pose: Array) -> list[float]:
    """Of the centres of submaps from a pose (3,) [m]."""
    bases = graph.poses[[m.anchor.index for m in among]]
    grids = se2.compose(bases, np.array([m.T_anchor_grid for m in among]))
    centres = se2.transform(grids, np.array([m.centre for m in among])[:, None])[:, 0]
    return [float(gap) for gap in np.hypot(*(centres - pose[:2]).T)]
