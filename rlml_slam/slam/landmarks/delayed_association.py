# SPDX-License-Identifier: Apache-2.0
"""Delayed association: matches that the front end left open, decided by later sightings."""

from __future__ import annotations

import numpy as np

from rlml_slam.matching.reflectors.multi_hypothesis import MultiHypothesis, Sight
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Interval, Sighting
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph

# The hypotheses are metres apart, and are decided by the pose after a stretch without reflectors,
# where wheels slip: sightings and motion are used with these larger covariances.
SPREAD = 0.2  # [m] added to the noise of a sighting, per axis
CORRELATED_SHARE = 0.3  # of the variance, among the detections of one keyframe
SLIP2 = 4.0  # factor of the covariance of a motion
DECIDED = 0.999  # probability of a match that merges two reflectors of the map
LIKELY = 0.5  # the same at the end of a run


class DelayedAssociation:
    """Hypotheses from the first new reflector until all new ones are decided.

    They begin with the joint covariance of the graph, which contains scans and closures.
    """

    def __init__(self, params: Reflector, reflectors: ReflectorGraph) -> None:
        self._p = params
        self._reflectors = reflectors
        self._hypotheses: MultiHypothesis | None = None

    @property
    def pending(self) -> frozenset[int]:
        """Keys of reflectors that are not decided."""
        return frozenset() if self._hypotheses is None else self._hypotheses.pending

    def begins(self, interval: Interval) -> bool:
        """Whether this interval has the first undecided reflector; the graph should be solved."""
        return (
            self._hypotheses is None
            and self._reflectors.found
            and any(
                self._reflectors.count(key) + _count(groups) >= self._p.min_sightings
                and not self._reflectors.is_mapped(key)
                for key, groups in interval.sightings.items()
                if key not in interval.ids
            )
        )

    def begin(self, pose: int) -> None:
        """Begin the hypotheses at keyframe ``pose``, from the belief of the graph."""
        belief = self._reflectors.belief(pose)
        self._hypotheses = MultiHypothesis(
            belief.T_map_base, belief.keys, belief.points, belief.cov, self._p.unmapped_density
        )

    def drop(self) -> None:
        """Drop the hypotheses: a loop closure decided them."""
        self._hypotheses = None

    def add(self, interval: Interval) -> None:
        """Add the sightings near the newest keyframe, before the graph has them.

        A reflector with an id is decided: it is used where the hypotheses contain it.
        """
        sights = []
        for key, groups in interval.sightings.items():
            known = self._reflectors.resolve(key)
            seen = self._reflectors.count(known) + _count(groups)
            if self._hypotheses is None or seen < self._p.min_sightings:
                continue
            if known in self._hypotheses or key not in interval.ids:
                largest = max(groups, key=lambda g: g.count)
                sights.append(Sight(known, largest.z, _sighting_cov(largest)))
        if self._hypotheses is not None:
            self._hypotheses.see(sights)

    def move(self, delta: Array, cov: Array) -> None:
        """Move by the motion (3,) to the next keyframe with covariance (3, 3)."""
        if self._hypotheses is not None:
            self._hypotheses.move(delta, SLIP2 * cov)

    def decide(self, final: bool = False) -> bool:
        """Merge the reflectors that are decided to be one; whether there were any."""
        if self._hypotheses is None:
            return False
        answers = self._hypotheses.answers(LIKELY if final else DECIDED)
        if not self._hypotheses.pending:
            self._hypotheses = None
        same = [(known, key) for key, known in answers.items() if known != key]
        for known, key in same:
            self._reflectors.join(known, key)
        return bool(same)


def _count(groups: list[Sighting]) -> int:
    return sum(g.count for g in groups)


def _sighting_cov(sighting: Sighting) -> Array:
    """Covariance (2, 2) of a sighting whose detections are correlated."""
    factor = 1.0 + CORRELATED_SHARE * (sighting.count - 1)
    cov: Array = factor * np.linalg.inv(sighting.information) + SPREAD**2 * np.eye(2)
    return cov
