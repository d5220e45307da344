# SPDX-License-Identifier: Apache-2.0
"""Where a loop closes by reflectors alone: some lie as others do that were mapped before.

They need no ids, and it does not matter how far the pose has drifted meanwhile: what was mapped
since is searched as one constellation among all that was not seen since (matching/constellation).
It is a candidate where the verdict is unique; whether it enters is decided as for any closure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.matching.reflectors.constellation import Candidate, locate
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.reflector_graph import COMMON2, ReflectorGraph
from rlml_slam.types import Verdict

LEAST = 4  # three fit in many a place; each further one has to agree with them
# Chance that a wrong place, alike in some reflectors, is alike in one more: racks and columns are
# set up in rows, so it is far more than the share of the floor that the gates cover.
ALIKE = 0.1
# [m, m, rad] how well the closure holds its place: enough to tell it. The sightings of the
# reflectors, which become one with it, know it better and must not count twice.
SIGMA = np.array([0.1, 0.1, 0.02])


@dataclass(frozen=True)
class Place:
    """Keyframe ``key`` at ``T_map_key`` (3,), which is ``T_anchor_key`` with cov (3, 3) there.

    ``pairs`` are the keys of reflectors that are one, the older first. ``area`` [m²] was
    searched; ``odds`` is the logarithm of how much likelier right than chance it is.
    """

    anchor: Keyframe
    key: Keyframe
    T_map_key: Array
    T_anchor_key: Array
    cov: Array
    pairs: tuple[tuple[int, int], ...]
    share: float
    area: float
    odds: float


class Constellations:
    """Looks again whenever another reflector is new.

    ``not_searched`` counts the times when there was too much to be searched.
    """

    def __init__(self, params: Parameters, graph: Graph, reflectors: ReflectorGraph) -> None:
        self._p = params
        self._graph = graph
        self._reflectors = reflectors
        self._looked: frozenset[int] = frozenset()
        self.not_searched = 0

    def look(self, keys: Sequence[Keyframe]) -> Place | None:
        """Where the newest of some keyframes is among what was mapped before, if that is told."""
        if not self._p.loop_closure.enabled or not keys:
            return None
        begin = keys[-1].index - self._p.back_end.submap_size
        if begin <= 0:
            return None
        marks = [m for m in self._reflectors.alive() if len(m.sightings)]
        new = [m for m in marks if m.sightings.view['pose'].min() > begin]
        names = frozenset(m.key for m in new)
        if len(new) < LEAST or names <= self._looked:
            return None
        self._looked = names
        old = [m for m in marks if m.sightings.view['pose'].max() <= begin]
        if len(old) < LEAST:
            return None
        key = keys[-1]
        pose = self._graph.poses[key.index]
        points, cov = self._seen_from(pose, new)
        places, spread = self._seen_from(np.zeros(3), old)
        stars = locate(points, cov, places, spread, self._p.relocalization)
        self.not_searched += stars.verdict is Verdict.NOT_SEARCHED
        if stars.verdict is not Verdict.UNIQUE or stars.candidates[0].num_matches < LEAST:
            return None
        return self._place(keys, stars.candidates[0], new, old, stars.chance, places)

    def _seen_from(self, pose: Array, marks: Sequence[Landmark]) -> tuple[Array, Array]:
        """Where reflectors are (m, 2), by what they were seen from and no more, cov (m, 2, 2)."""
        X = self._graph.poses
        points = se2.transform(se2.inverse(pose), self._graph.landmarks[[m.index for m in marks]])
        W = []
        for m in marks:
            s = m.sightings.view
            R = se2.rotation(X[s['pose'], 2] - pose[2])
            W.append((R @ s['information'] @ np.swapaxes(R, 1, 2)).sum(axis=0))
        return points, np.asarray(np.linalg.inv(np.array(W)) + np.diag(COMMON2), np.float64)

    def _place(
        self,
        keys: Sequence[Keyframe],
        found: Candidate,
        new: Sequence[Landmark],
        old: Sequence[Landmark],
        chance: float,
        places: Array,
    ) -> Place:
        hits = np.flatnonzero(found.match >= 0).tolist()
        pairs = tuple((old[found.match[k]].key, new[k].key) for k in hits)
        seen = np.concatenate([old[found.match[k]].sightings.view['pose'] for k in hits])
        poses = self._graph.poses
        # of the keyframes that saw most of them, the nearest
        who, count = np.unique(seen, return_counts=True)
        gap = np.hypot(*(poses[who, :2] - found.pose[:2]).T)
        anchor = int(who[np.lexsort((gap, -count))[0]])
        R = np.eye(3)
        R[:2, :2] = se2.rotation(poses[anchor, 2]).T
        extent = np.ptp(places, axis=0) + 2.0 * self._p.loop_closure.search_window
        odds = min(-math.log(max(chance, 1e-300)), -(len(hits) - LEAST + 1) * math.log(ALIKE))
        return Place(
            keys[anchor], keys[-1], found.pose, se2.between(poses[anchor], found.pose),
            R @ found.cov @ R.T + np.diag(SIGMA**2), pairs, len(hits) / len(new),
            float(extent.prod()), odds,
        )  # fmt: skip
