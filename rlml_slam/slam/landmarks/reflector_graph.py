# SPDX-License-Identifier: Apache-2.0
"""Reflectors of the graph: added after enough sightings, merged where two are one, removed."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.estimation.landmark_merging import MergeTest
from rlml_slam.graph import Marginals, OnlineSolver, RelativePoses, Renumbering
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array, transform
from rlml_slam.slam.keyframes import Interval
from rlml_slam.slam.landmarks.landmark import SIGHTING, Landmark, in_order_of_rank
from rlml_slam.slam.landmarks.reflector_arrays import arrays_of, reflectors_of
from rlml_slam.slam.landmarks.reflector_merging import find_same
from rlml_slam.slam.landmarks.removed_landmarks import RemovedLandmarks
from rlml_slam.slam.landmarks.sighting_factors import SightingFactors
from rlml_slam.types import ANONYMOUS, Belief, Reflectors


class ReflectorGraph:
    """Sightings (e^R of eq. 12) and landmarks; keys are the front end's."""

    def __init__(self, params: Reflector, solver: OnlineSolver) -> None:
        self._p = params
        self._solver = solver
        self._graph = solver.graph
        self._same = MergeTest(
            gate(params.gate), params.min_separation, params.match_probability,
            params.unmapped_density,
        )  # fmt: skip
        self._landmarks: dict[int, Landmark] = {}
        self._alias: dict[int, int] = {}  # keys of merged reflectors
        self.removed = RemovedLandmarks()
        self._removed_keys: set[int] = set()  # that the front end may still have
        self._factors = SightingFactors(solver)

    @property
    def changed(self) -> bool:
        """Whether sightings were added or removed since the last solve."""
        return self._factors.changed

    def mark_solved(self) -> None:
        """The estimate contains all sightings."""
        self._factors.changed = False

    # --- sightings -----------------------------------------------------------------------------

    def add(self, pose: int, interval: Interval) -> None:
        """Add the reflectors seen near keyframe ``pose``."""
        together = {self.resolve(key) for key in interval.sightings}
        for key, s in ((k, s) for k, groups in interval.sightings.items() for s in groups):
            landmark = self._landmarks.setdefault(self.resolve(key), Landmark(self.resolve(key)))
            landmark.id = interval.ids.get(key, landmark.id)
            landmark.diameter = interval.diameters.get(key, landmark.diameter)
            self._removed_keys.discard(landmark.key)
            landmark.count += s.count
            landmark.history.add_sighting(interval.first_stamp, interval.last_stamp)
            landmark.seen_together |= together
            # errors of consecutive detections are correlated: many do not average out
            weight = 1.0 / (1.0 + self._p.correlated_share * (s.count - 1))
            row = np.zeros(1, dtype=SIGHTING)
            row['pose'], row['factor'] = pose, -1
            row['z'], row['information'] = s.z, weight * s.information
            landmark.sightings.append(row)
            if landmark.index < 0 and landmark.count >= self._p.min_sightings:
                point = transform(self._graph.poses[pose], s.z[None])[0]
                landmark.index = self._graph.add_landmark(point)
            self._factors.add(landmark)
        num = sum(map(len, interval.sightings.values()))
        self._factors.num_added += np.array([num > 0, num])

    def move(self, ties: Mapping[int, tuple[int, RelativePoses]]) -> None:
        """Move sightings of marginalized keyframes, as SightingFactors.move."""
        self._factors.move(self._landmarks.values(), ties)

    def thin(self, pose: int) -> None:
        """Bound the sightings of a keyframe, as SightingFactors.thin."""
        self._factors.thin(self._landmarks.values(), pose)

    def resolve(self, key: int) -> int:
        """The current key of a reflector that may have been merged."""
        while key in self._alias:
            key = self._alias[key]
        return key

    @property
    def found(self) -> bool:
        """Whether the graph has any reflector."""
        return bool(self.alive())

    def alive(self) -> list[Landmark]:
        """The reflectors in the graph."""
        return [m for m in self._landmarks.values() if m.index >= 0]

    def place(self, m: Landmark) -> Array:
        """Position (2,) of a reflector of the graph."""
        point: Array = self._graph.landmarks[m.index].copy()
        return point

    def keys(self) -> frozenset[int]:
        """Keys of the reflectors in the graph."""
        return frozenset(m.key for m in self.alive())

    def is_mapped(self, key: int) -> bool:
        """Whether a reflector is in the graph."""
        landmark = self._landmarks.get(self.resolve(key))
        return landmark is not None and landmark.index >= 0

    def count(self, key: int) -> int:
        """Number of detections of a reflector, in the graph or not."""
        landmark = self._landmarks.get(self.resolve(key))
        return 0 if landmark is None else landmark.count

    @property
    def next_key(self) -> int:
        """The first key that was never used."""
        return 1 + max([*self._landmarks, *self._alias, *self.removed.keys], default=-1)

    def belief(self, pose: int) -> Belief:
        """Pose ``pose`` and all reflectors with their joint covariance."""
        alive = sorted(self.alive(), key=lambda m: m.key)
        index = [m.index for m in alive]
        cov = self._solver.joint([pose], index)
        return Belief(
            self._graph.poses[pose].copy(),
            np.array([m.key for m in alive], dtype=np.int64),
            self._graph.landmarks[index].reshape(-1, 2),
            cov,
            {key: self.resolve(key) for key in self._alias},
            tuple(self._removed_keys),
        )

    def reflectors(self) -> Reflectors:
        """The map's reflectors with marginal covariances, sorted by key."""
        alive = sorted(self.alive(), key=lambda m: m.key)
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

    # --- survey --------------------------------------------------------------------------------

    def surveyed(self) -> dict[int, int]:
        """Rows of the survey by key, of the surveyed reflectors."""
        return {m.key: m.surveyed for m in self.alive() if m.surveyed >= 0}

    def set_surveyed(self, key: int, row: int, id_: int) -> int:
        """Assign a row of the survey to a reflector, or none (-1); its landmark."""
        landmark = self._landmarks[key]
        landmark.surveyed = row
        landmark.id = id_ if landmark.id == ANONYMOUS else landmark.id
        return landmark.index

    def key_of(self, index: int) -> int:
        """Key of the reflector that is landmark ``index`` of the graph."""
        return next(m.key for m in self.alive() if m.index == index)

    def clear_views(self) -> None:
        """The map has moved: the cells of the floor are others."""
        for m in self._landmarks.values():
            m.views.clear()

    # --- merging -------------------------------------------------------------------------------

    def merge(self, pending: Collection[int] = ()) -> bool:
        """Merge each pair that is close, statistically equal and never seen together.

        Reflectors with ``pending`` hypotheses are left. Returns whether any pair was merged.
        """
        alive = [m for m in self.alive() if m.key not in pending]
        pairs = find_same(self._solver, alive, self._same)
        for a, b in pairs:
            self._merge(*in_order_of_rank(a, b))
        return bool(pairs)

    def join(self, a: int, b: int) -> None:
        """Merge the reflectors of two keys, unless their identities differ.

        The first one stays, or the one that is in the graph.
        """
        first, second = (
            self._landmarks.setdefault(key, Landmark(key)) for key in map(self.resolve, (a, b))
        )
        if first is second or first.has_other_identity(second):
            return
        self._merge(*in_order_of_rank(first, second))

    def join_mapped(self, pairs: Iterable[tuple[int, int]]) -> bool:
        """Merge pairs of keys of which both are in the graph; whether there were any."""
        mapped = self.keys()
        chosen = [(a, b) for a, b in pairs if {self.resolve(a), self.resolve(b)} <= mapped]
        for a, b in chosen:
            self.join(a, b)
        return bool(chosen)

    def _merge(self, keep: Landmark, other: Landmark) -> None:
        self._factors.disable(other.sightings.view)
        keep.sightings.append(other.sightings.view)
        self._factors.add(keep)
        keep.absorb(other)
        for m in self._landmarks.values():
            if other.key in m.seen_together:
                m.seen_together.add(keep.key)
        self._alias[other.key] = keep.key
        del self._landmarks[other.key]

    def remove(self, landmarks: Iterable[Landmark]) -> tuple[int, ...]:
        """Remove reflectors that are no longer present; all keys that they ever had."""
        keys: list[int] = []
        for m in landmarks:
            self.removed.add(m, self._graph.landmarks[m.index])
            self._factors.disable(m.sightings.view)
            priors = self._graph.landmark_priors
            priors.enabled[priors.nodes[:, 0] == m.index] = False
            keys += [m.key, *(a for a in self._alias if self.resolve(a) == m.key)]
            del self._landmarks[m.key]
            self._factors.changed = True
        self._removed_keys.update(keys)
        for other in self._landmarks.values():
            other.seen_together.difference_update(keys)
        return tuple(keys)

    def drop_candidates(self, before: int, pending: Collection[int] = ()) -> None:
        """Remove candidates that were not seen since a stamp [ns]: ghosts."""
        for m in list(self._landmarks.values()):
            if m.index < 0 and m.history.last < before and m.key not in pending:
                rows = m.sightings.view
                if len(rows):
                    pose = self._graph.poses[rows['pose'][-1]]
                    self.removed.add(m, transform(pose, rows['z'][-1:])[0])
                del self._landmarks[m.key]
                for other in self._landmarks.values():
                    other.seen_together.discard(m.key)

    def used_landmarks(self) -> NDArray[np.bool_]:
        """Whether each landmark of the graph (m,) is a current reflector."""
        used = np.zeros(len(self._graph.landmarks), dtype=np.bool_)
        used[[m.index for m in self.alive()]] = True
        return used

    def renumber(self, new: Renumbering) -> None:
        """Follow the removal of poses, landmarks and factors from the graph."""
        self._factors.renumber(self._landmarks.values(), new)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All reflectors, to be saved."""
        return {
            **arrays_of(self._landmarks.values()),
            **self.removed.arrays(),
            'reflector_num_added': self._factors.num_added.copy(),
            'reflector_alias': np.array(list(self._alias.items()), dtype=np.int64).reshape(-1, 2),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the reflectors of a saved map, with the graph that belongs to it."""
        a = arrays
        self.removed.restore(a)
        self._landmarks = reflectors_of(a)
        self._alias = dict(a['reflector_alias'].tolist())
        # a merged or imported map has no such numbers: those of its sightings
        left = len(np.unique(a['sighting']['pose'])), len(a['sighting'])
        self._factors.num_added[:] = a.get('reflector_num_added', left)
