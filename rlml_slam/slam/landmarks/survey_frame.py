# SPDX-License-Identifier: Apache-2.0
"""Alignment of the graph with a survey, whose frame becomes that of the map.

When the reflectors match the survey at exactly one pose, the whole graph is moved there, and each
surveyed reflector gets a prior at its surveyed position. Until then, the first keyframe is the
gauge. A reflector whose sightings contradict its prior was moved: the prior is disabled.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.graph import OnlineSolver
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.pair_votes import MIN_MATCHES
from rlml_slam.matching.reflectors.survey_alignment import pairs_at, place
from rlml_slam.params import Parameters
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.types import ANONYMOUS

GROWTH = 1.1  # the constellation is matched again when it has grown by this factor


class SurveyFrame:
    """Aligns the reflectors of a graph with a survey; ``why`` describes the state in words."""

    def __init__(
        self, params: Parameters, solver: OnlineSolver, reflectors: ReflectorGraph, survey: Survey
    ) -> None:
        self.survey = survey
        self.found = False
        self.why = 'no reflectors yet'
        self._sigma = params.back_end.survey_sigma
        self._limit = gate(params.reflector.new_gate)
        self._solver = solver
        self._graph = solver.graph
        self._reflectors = reflectors
        self._matched: frozenset[int] = frozenset()  # keys at the last match
        self._rejected: set[int] = set()

    def update(self) -> bool:
        """Match the current reflectors; whether the graph has changed and has to be solved."""
        if self.found and self._reject_worst():
            return True
        keys = self._reflectors.keys()
        new = keys - self._matched
        if not new or (not self.found and len(keys) < GROWTH * len(self._matched)):
            return False
        self._matched = keys
        return self._add_priors() if self.found else self._align()

    def _align(self) -> bool:
        """Move the graph to the frame of the survey, if the constellation fits at one pose."""
        placed = place(self._reflectors.reflectors(), self.survey, self._sigma)
        self.why = placed.why
        if placed.T_survey_map is None:
            return False
        self._graph.move(placed.T_survey_map)
        self._solver.start_over()
        self._reflectors.clear_views()
        self.found = True
        return self._add_priors()

    def _add_priors(self) -> bool:
        """Add priors at the surveyed positions; whether any is new."""
        known = self._reflectors.reflectors()
        rows = self._reflectors.surveyed()
        information = np.eye(2) / self._sigma**2
        new = 0
        for i, k in pairs_at(known, self.survey, np.zeros(3), self._sigma).tolist():
            key = int(known.keys[i])
            if key in rows or k in rows.values() or key in self._rejected:
                continue
            index = self._reflectors.set_surveyed(key, k, int(self.survey.ids[k]))
            self._graph.add_landmark_prior(index, self.survey.points[k], information)
            new += 1
        self.update_gauge()
        self.why = f'{len(rows) + new} of {len(self.survey.points)} surveyed reflectors'
        return new > 0

    def _reject_worst(self) -> bool:
        """Disable the prior with the largest residual, if it is outside the gate.

        One at a time: a wrong prior pulls its neighbours away as well.
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
        self._rejected.add(key)
        self._reflectors.set_surveyed(key, -1, ANONYMOUS)
        return True

    def update_gauge(self) -> None:
        """Fix the first keyframe where too few reflectors have priors."""
        tied = int(self._graph.landmark_priors.enabled.sum())
        self._graph.fixed_poses[0] = tied < MIN_MATCHES
