# SPDX-License-Identifier: Apache-2.0
"""Loop closures from reflector constellations: recent reflectors matched with older ones.

Neither ids nor an accurate pose are needed: the reflectors mapped recently are searched as one
constellation among those not seen since (matching/reflectors/constellation.py). A unique match is
a closure candidate, verified like any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.graph import Graph
from rlml_slam.matching.reflectors.constellation import Candidate, locate
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.sighting_reduction import COMMON2
from rlml_slam.types import Verdict

MIN_MATCHES = 4  # three reflectors fit at many poses; a fourth one has to agree
# Probability that a wrong pose which fits some reflectors fits one more: racks and columns stand
# in rows, so it is far larger than the share of the floor that the gates cover.
REPEATED_WRONG = 0.1
# [m, m, rad] standard deviation of the closure. It is larger than that of the matched reflectors,
# whose sightings are merged with the closure and must not be counted twice.
SIGMA = np.array([0.1, 0.1, 0.02])


@dataclass(frozen=True)
class ConstellationMatch:
    """Keyframe ``key`` at ``T_map_key`` (3,), ``T_anchor_key`` with cov (3, 3) from ``anchor``.

    ``reflector_pairs`` are the keys of matched reflectors, the older first. ``search_area`` [m²];
    ``log_odds`` of a correct match against one by chance; ``share`` of the new reflectors matched.
    """

    anchor: Keyframe
    key: Keyframe
    T_map_key: Array
    T_anchor_key: Array
    cov: Array
    reflector_pairs: tuple[tuple[int, int], ...]
    share: float
    search_area: float
    log_odds: float


class ConstellationSearch:
    """Search whenever another reflector is new.

    ``not_searched`` counts searches that were skipped because they would have been too large.
    """

    def __init__(self, params: Parameters, graph: Graph, reflectors: ReflectorGraph) -> None:
        self._p = params
        self._graph = graph
        self._reflectors = reflectors
        self._searched: frozenset[int] = frozenset()
        self.not_searched = 0

    def search(self, keys: Sequence[Keyframe]) -> ConstellationMatch | None:
        """Unique match of the reflectors near the newest keyframe with older ones, or None."""
        if not self._p.loop_closure.enabled or not keys:
            return None
        begin = keys[-1].index - self._p.back_end.submap_size
        if begin <= 0:
            return None
        landmarks = [m for m in self._reflectors.alive() if len(m.sightings)]
        new = [m for m in landmarks if m.sightings.view['pose'].min() > begin]
        names = frozenset(m.key for m in new)
        if len(new) < MIN_MATCHES or names <= self._searched:
            return None
        self._searched = names
        old = [m for m in landmarks if m.sightings.view['pose'].max() <= begin]
        if len(old) < MIN_MATCHES:
            return None
        key = keys[-1]
        pose = self._graph.poses[key.index]
        points, cov = self._relative_to(pose, new)
        old_points, old_cov = self._relative_to(np.zeros(3), old)
        found = locate(points, cov, old_points, old_cov, self._p.relocalization)
        self.not_searched += found.verdict is Verdict.NOT_SEARCHED
        if found.verdict is not Verdict.UNIQUE or found.candidates[0].num_matches < MIN_MATCHES:
            return None
        return self._match(keys, found.candidates[0], new, old, found.chance, old_points)

    def _relative_to(self, pose: Array, landmarks: Sequence[Landmark]) -> tuple[Array, Array]:
        """Positions (m, 2) from a pose, and covariances (m, 2, 2) of their sightings alone."""
        X = self._graph.poses
        points = se2.transform(
            se2.inverse(pose), self._graph.landmarks[[m.index for m in landmarks]]
        )
        W = []
        for m in landmarks:
            s = m.sightings.view
            R = se2.rotation(X[s['pose'], 2] - pose[2])
            W.append((R @ s['information'] @ np.swapaxes(R, 1, 2)).sum(axis=0))
        return points, np.asarray(np.linalg.inv(np.array(W)) + np.diag(COMMON2), np.float64)

    def _match(
        self,
        keys: Sequence[Keyframe],
        found: Candidate,
        new: Sequence[Landmark],
        old: Sequence[Landmark],
        chance: float,
        old_points: Array,
    ) -> ConstellationMatch:
        hits = np.flatnonzero(found.match >= 0).tolist()
        pairs = tuple((old[found.match[k]].key, new[k].key) for k in hits)
        seen = np.concatenate([old[found.match[k]].sightings.view['pose'] for k in hits])
        poses = self._graph.poses
        # the nearest of the keyframes that saw most of them
        who, count = np.unique(seen, return_counts=True)
        gap = np.hypot(*(poses[who, :2] - found.pose[:2]).T)
        anchor = int(who[np.lexsort((gap, -count))[0]])
        extent = np.ptp(old_points, axis=0) + 2.0 * self._p.loop_closure.search_window
        repeated = -(len(hits) - MIN_MATCHES + 1) * math.log(REPEATED_WRONG)
        log_odds = min(-math.log(max(chance, 1e-300)), repeated)
        return ConstellationMatch(
            keys[anchor], keys[-1], found.pose, se2.between(poses[anchor], found.pose),
            se2.rotate_cov(found.cov, -poses[anchor, 2]) + np.diag(SIGMA**2), pairs,
            len(hits) / len(new),
            float(extent.prod()), log_odds,
        )  # fmt: skip
