# SPDX-License-Identifier: Apache-2.0
"""Surveyed reflectors in the graph: they define the frame of the map, and hold it there.

Once the reflectors tell where the map lies in the survey, the whole graph is put there, and each
reflector that is one of the survey gets its surveyed place as a prior. The first keyframe is the
gauge until then. A reflector that the sightings see elsewhere loses its prior again: it was moved.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.pair_votes import MIN_MATCHES
from rlml_slam.matching.reflectors.survey_alignment import pairs_at, place
from rlml_slam.params import Parameters
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.types import ANONYMOUS

GROWTH = 1.1  # the constellation is looked at again when it has grown by this, or by one


class SurveyFrame:
    """Ties the reflectors of a graph to a survey; ``why`` says in words how far that has come."""

    def __init__(
        self, params: Parameters, live: OnlineSolver, reflectors: ReflectorGraph, survey: Survey
    ) -> None:
        self.survey = survey
        self.found = False
        self.why = 'no reflectors yet'
        self._sigma = params.back_end.survey_sigma
        self._limit = gate(params.reflector.new_gate)
        self._live = live
        self._graph = live.graph
        self._reflectors = reflectors
        self._asked: frozenset[int] = frozenset()
        self._refused: set[int] = set()

    def update(self) -> bool:
        """Use what the reflectors tell now; whether the graph has changed and is to be solved."""
        if self.found and self._refuse_worst():
            return True
        keys = self._reflectors.keys()
        new = keys - self._asked
        if not new or (not self.found and len(keys) < GROWTH * len(self._asked)):
            return False
        self._asked = keys
        return self._tie() if self.found else self._enter()

    def _enter(self) -> bool:
        """Put the graph where the survey says, if it does."""
        placed = place(self._reflectors.reflectors(), self.survey, self._sigma)
        self.why = placed.why
        if placed.T_survey_map is None:
            return False
        self._graph.move(placed.T_survey_map)
        self._live.start_over()
        self._reflectors.forget_views()
        self.found = True
        return self._tie()

    def _tie(self) -> bool:
        """Give the reflectors that are of the survey its places; whether any was new."""
        known = self._reflectors.reflectors()
        rows = self._reflectors.surveyed()
        information = np.eye(2) / self._sigma**2
        new = 0
        for i, k in pairs_at(known, self.survey, np.zeros(3), self._sigma).tolist():
            key = int(known.keys[i])
            if key in rows or k in rows.values() or key in self._refused:
                continue
            index = self._reflectors.survey(key, k, int(self.survey.ids[k]))
            self._graph.add_landmark_prior(index, self.survey.points[k], information)
            new += 1
        self.hold()
        self.why = f'{len(rows) + new} of {len(self.survey.points)} surveyed reflectors'
        return new > 0

    def _refuse_worst(self) -> bool:
        """Take the prior from the reflector that is farthest from its place, if it was moved.

        One at a time: it pulls its neighbours away as well.
        """
        priors = self._graph.landmark_priors
        left = np.flatnonzero(priors.enabled)
        if len(left) <= MIN_MATCHES:
            return False
        d2 = self._graph.residuals().landmark_priors[left]
        worst = int(left[np.argmax(d2)])
        if d2.max() < self._limit:
            return False
        priors.enabled[worst] = False
        index = int(priors.nodes[worst, 0])
        key = self._reflectors.key_of(index)
        self._refused.add(key)
        self._reflectors.survey(key, -1, ANONYMOUS)
        return True

    def hold(self) -> None:
        """The first keyframe is the gauge where too few reflectors are."""
        tied = int(self._graph.landmark_priors.enabled.sum())
        self._graph.fixed_poses[0] = tied < MIN_MATCHES
