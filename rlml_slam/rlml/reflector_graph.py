# SPDX-License-Identifier: Apache-2.0
"""The graph's reflectors: born after enough sightings, merged where two turn out to be one."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from rlml_slam.graph.graph import Graph
from rlml_slam.graph.marginals import Marginals
from rlml_slam.matching.association import gate
from rlml_slam.params import Reflector
from rlml_slam.rlml.keyframes import Interval
from rlml_slam.se2 import Array, transform
from rlml_slam.types import ANONYMOUS, Belief, Reflectors

MERGE_DISTANCE = 1.5  # [m] pairs farther apart are not looked at


@dataclass
class _Landmark:
    """One reflector of the graph; ``sightings`` are (pose, z, information, factor)."""

    key: int
    index: int = -1
    id: int = ANONYMOUS
    diameter: float = float('nan')
    count: int = 0
    sightings: list[tuple[int, Array, Array, int]] = field(default_factory=list)


class ReflectorGraph:
    """Sightings (e^R of eq. 12) and landmarks; keys are the front end's."""

    def __init__(self, params: Reflector, graph: Graph) -> None:
        self._p = params
        self._graph = graph
        self._landmarks: dict[int, _Landmark] = {}
        self._alias: dict[int, int] = {}
        self.changed = False

    def resolve(self, key: int) -> int:
        """The key under which a merged reflector goes on."""
        while key in self._alias:
            key = self._alias[key]
        return key

    def add(self, pose: int, interval: Interval) -> None:
        """The reflectors seen near keyframe ``pose``."""
        for key, s in ((k, s) for k, groups in interval.sightings.items() for s in groups):
            landmark = self._landmarks.setdefault(self.resolve(key), _Landmark(self.resolve(key)))
            landmark.id = interval.ids.get(key, landmark.id)
            landmark.diameter = interval.diameters.get(key, landmark.diameter)
            landmark.count += s.count
            # errors of a sensor are alike from one message to the next: many do not average out
            worth = 1.0 / (1.0 + self._p.alike * (s.count - 1))
            landmark.sightings.append((pose, s.z, worth * s.information, -1))
            if landmark.index < 0 and landmark.count >= self._p.min_sightings:
                point = transform(self._graph.poses[pose], s.z[None])[0]
                landmark.index = self._graph.add_landmark(point)
            self._link_all(landmark)

    def _link_all(self, landmark: _Landmark) -> None:
        """Give a landmark of the graph the factors that it still lacks."""
        if landmark.index >= 0:
            for k, (_, _, _, factor) in enumerate(landmark.sightings):
                if factor < 0:
                    self._link(landmark, k)

    def _link(self, landmark: _Landmark, k: int) -> None:
        pose, z, information, _ = landmark.sightings[k]
        factor = self._graph.add_sighting(pose, landmark.index, z, information)
        landmark.sightings[k] = (pose, z, information, factor)
        self.changed = True

    @property
    def found(self) -> bool:
        """Whether there is any reflector in the graph."""
        return bool(self._alive())

    def _alive(self) -> list[_Landmark]:
        return [m for m in self._landmarks.values() if m.index >= 0]

    def is_mapped(self, key: int) -> bool:
        """Whether the reflector has entered the graph."""
        landmark = self._landmarks.get(self.resolve(key))
        return landmark is not None and landmark.index >= 0

    def merge(self, pending: Collection[int] = ()) -> bool:
        """Make one of each pair that is close, statistically equal and never seen together.

        Where the two places are uncertain, that could as well be two reflectors, and is left;
        those whose keys are ``pending`` are another's to decide.
        """
        alive = [m for m in self._alive() if m.key not in pending]
        if len(alive) < 2:
            return False
        points = self._graph.landmarks[[m.index for m in alive]]
        gap = np.linalg.norm(points[:, None] - points[None], axis=-1)
        pairs = [(i, j) for i, j in np.argwhere(gap < MERGE_DISTANCE) if i < j]
        pairs = [(i, j) for i, j in pairs if not self._distinct(alive[i], alive[j])]
        if not pairs:
            return False
        marginals = Marginals(self._graph)
        merged: set[int] = set()
        limit = gate(self._p.gate)
        for i, j in sorted(pairs, key=lambda p: gap[p[0], p[1]]):
            if i in merged or j in merged:
                continue
            cov = _difference_cov(marginals, alive[i].index, alive[j].index) + 1e-6 * np.eye(2)
            peak = 1.0 / (2.0 * math.pi * math.sqrt(np.linalg.det(cov)))
            if peak < self._p.sure * (peak + self._p.density):
                continue
            d = points[i] - points[j]
            near = gap[i, j] < self._p.min_separation
            if near or d @ np.linalg.solve(cov, d) < limit:
                self._absorb(alive[i], alive[j])
                merged |= {i, j}
        return bool(merged)

    @staticmethod
    def _distinct(a: _Landmark, b: _Landmark) -> bool:
        """Whether the two were seen from one keyframe, or tell different ids."""
        if _named_apart(a, b):
            return True
        return not {s[0] for s in a.sightings}.isdisjoint(s[0] for s in b.sightings)

    def join(self, a: int, b: int) -> None:
        """The reflectors of two keys are one, if their ids do not say otherwise.

        The first goes on, or the one that the graph has.
        """
        first, second = (
            self._landmarks.setdefault(key, _Landmark(key)) for key in map(self.resolve, (a, b))
        )
        if first is second or _named_apart(first, second):
            return
        if first.index < 0 <= second.index:
            first, second = second, first
        self._absorb(first, second)

    def _absorb(self, keep: _Landmark, gone: _Landmark) -> None:
        for pose, z, information, factor in gone.sightings:
            if factor >= 0:
                self._graph.sightings.enabled[factor] = False
            keep.sightings.append((pose, z, information, -1))
        self._link_all(keep)
        keep.count += gone.count
        keep.id = gone.id if keep.id == ANONYMOUS else keep.id
        keep.diameter = gone.diameter if math.isnan(keep.diameter) else keep.diameter
        self._alias[gone.key] = keep.key
        del self._landmarks[gone.key]

    def belief(self, pose: int) -> Belief:
        """Pose ``pose`` and all reflectors with their joint covariance."""
        alive = sorted(self._alive(), key=lambda m: m.key)
        index = [m.index for m in alive]
        return Belief(
            self._graph.poses[pose].copy(),
            np.array([m.key for m in alive], dtype=np.int64),
            self._graph.landmarks[index].reshape(-1, 2),
            Marginals(self._graph).joint([pose], index),
            {key: self.resolve(key) for key in self._alias},
        )

    def reflectors(self) -> Reflectors:
        """The map's reflectors with marginal covariances, sorted by key."""
        alive = sorted(self._alive(), key=lambda m: m.key)
        index = [m.index for m in alive]
        cov = Marginals(self._graph).landmarks(index) if alive else np.zeros((0, 2, 2))
        return Reflectors(
            np.array([m.key for m in alive], dtype=np.int64),
            self._graph.landmarks[index].copy() if alive else np.zeros((0, 2)),
            cov,
            np.array([m.id for m in alive], dtype=np.int64),
            np.array([m.count for m in alive], dtype=np.int64),
            np.array([m.diameter for m in alive], dtype=np.float64),
        )


def _named_apart(a: _Landmark, b: _Landmark) -> bool:
    """Whether the two tell different ids."""
    return a.id != ANONYMOUS and b.id != ANONYMOUS and a.id != b.id


def _difference_cov(marginals: Marginals, a: int, b: int) -> Array:
    """Covariance (2, 2) of landmark a minus landmark b."""
    joint = marginals.joint([], [a, b])
    D = np.hstack([np.eye(2), -np.eye(2)])
    cov: Array = D @ joint @ D.T
    return cov
