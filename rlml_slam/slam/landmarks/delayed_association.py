# SPDX-License-Identifier: Apache-2.0
"""Matches that the front end left open, decided when later sightings tell."""

from __future__ import annotations

import numpy as np

from rlml_slam.matching.reflectors.multi_hypothesis import MultiHypothesis, Sight
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Interval, Sighting
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph

# The answers lie metres apart and are told by where a robot comes out of a blind stretch: nothing
# finer than this may speak for one of them, nor anything surer of the wheels than twice their
# sigma, for that is where they slip.
SPREAD = 0.2  # [m] added to the noise of a sighting, per axis
ALIKE = 0.3  # share of its variance that the detections of one keyframe have in common
SLIP2 = 4.0  # variance of a motion, in those of the noise model
DECIDED = 0.999  # probability of a match that joins two reflectors of the map
LIKELY = 0.5  # the same when there will be no more evidence


class DelayedAssociation:
    """Nothing, until a keyframe brings an unknown reflector; then hypotheses, until all is told.

    They are seeded from the graph's own covariance, so that what it knows from scans and closures
    counts, and cost nothing while no reflector is new.
    """

    def __init__(self, params: Reflector, reflectors: ReflectorGraph) -> None:
        self._p = params
        self._reflectors = reflectors
        self._hypotheses: MultiHypothesis | None = None

    @property
    def pending(self) -> frozenset[int]:
        """Keys of reflectors that may turn out to be others."""
        return frozenset() if self._hypotheses is None else self._hypotheses.pending

    def begins(self, interval: Interval) -> bool:
        """Whether this interval brings the first question: the graph should be at its best."""
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
        """Open the question at keyframe ``pose``, from what the graph knows."""
        belief = self._reflectors.belief(pose)
        self._hypotheses = MultiHypothesis(
            belief.T_map_base, belief.keys, belief.points, belief.cov, self._p.unmapped_density
        )

    def drop(self) -> None:
        """The questions are answered by others: the map was laid anew."""
        self._hypotheses = None

    def see(self, interval: Interval) -> None:
        """The reflectors seen near the newest keyframe, before the graph has them.

        One that tells its id is no question: it counts where it is known, and is none's answer.
        """
        sights = []
        for key, groups in interval.sightings.items():
            known = self._reflectors.resolve(key)
            seen = self._reflectors.count(known) + _count(groups)
            if self._hypotheses is None or seen < self._p.min_sightings:
                continue
            if known in self._hypotheses or key not in interval.ids:
                most = max(groups, key=lambda g: g.count)
                sights.append(Sight(known, most.z, _noise(most)))
        if self._hypotheses is not None:
            self._hypotheses.see(sights)

    def move(self, delta: Array, cov: Array) -> None:
        """The motion (3,) to the next keyframe and its covariance (3, 3)."""
        if self._hypotheses is not None:
            self._hypotheses.move(delta, SLIP2 * cov)

    def decide(self, final: bool = False) -> bool:
        """Join in the graph what turned out to be one; whether anything was."""
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


def _noise(sighting: Sighting) -> Array:
    """Covariance (2, 2) of where a sighting says that its reflector is."""
    alike = 1.0 + ALIKE * (sighting.count - 1)
    cov: Array = alike * np.linalg.inv(sighting.information) + SPREAD**2 * np.eye(2)
    return cov
