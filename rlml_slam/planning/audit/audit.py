# SPDX-License-Identifier: Apache-2.0
"""The audit of a commissioned layout: a run against its plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.survey_alignment import place
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.audit.areas import measured, of_areas, of_lost
from rlml_slam.planning.audit.displacement import displacement
from rlml_slam.planning.audit.evidence import GATE, Evidence, gather
from rlml_slam.planning.audit.findings import Finding, of_reflectors, ranked
from rlml_slam.planning.audit.ghosts import ghosts
from rlml_slam.planning.audit.presence import presence
from rlml_slam.planning.audit.sightings import Sightings
from rlml_slam.planning.site import Site
from rlml_slam.types import Reflectors

SURVEY_SIGMA = 0.05  # [m] by which a layout and a map may differ where they are aligned


@dataclass(frozen=True)
class Audit:
    """``findings``, the most important first; ``figures`` are what audit.json has."""

    evidence: Evidence
    findings: tuple[Finding, ...]
    figures: dict[str, Any]


def make_audit(
    site: Site, s: Sightings, plan: Mapping[str, Any], p: Parameters,
    sensor: SimulatorParameters, tolerance: float,
) -> Audit:  # fmt: skip
    """Compare sightings in the frame of the site with the figures of its plan.

    ``tolerance`` [m]: sigma of the places of the layout. Raises MapError without any sighting.
    """
    if not len(site.reflectors):
        raise MapError('the layout has no reflectors')
    e = gather(site, s, p, sensor)
    there, shift = presence(e), displacement(e, tolerance)
    rows = measured(e, shift, plan, p.reflector)
    found = ranked(
        of_reflectors(e, there, shift, ghosts(e)) + of_lost(s) + of_areas(e, rows, plan)
    )
    return Audit(e, tuple(found), {
        'scans': len(e.sightings.stamps), 'detections': len(e.match),
        'unmatched': int((e.match < 0).sum()), 'usual_rate': there.usual,
        'dispersion': there.dispersion, 'areas': rows,
        'reflectors': [
            {'id': int(site.reflectors.ids[k]), 'x_m': float(x), 'y_m': float(y),
             'expected': int(there.expected[k]), 'seen': int(there.seen[k]),
             'chance': float(there.chance[k]),
             'displaced_m': None if np.isnan(shift.delta[k, 0]) else shift.delta[k].tolist()}
            for k, (x, y) in enumerate(site.reflectors.points)
        ],
        'findings': [{'kind': f.kind.value, 'x_m': f.x, 'y_m': f.y, 'what': f.what,
                      'advice': f.advice, 'share': f.share} for f in found],
    })  # fmt: skip


def in_frame_of(site: Site, s: Sightings, mapped: Reflectors) -> Sightings:
    """Sightings in the frame of the site, for a run that made a map of its own.

    ``mapped``: the reflectors of that map. Raises MapError where it does not fit the layout.
    """
    points = site.reflectors.points
    if not len(mapped) or not len(points):
        return s
    gap = np.hypot(*(mapped.points[:, None] - points).transpose(2, 0, 1)).min(axis=1)
    if np.mean(gap < GATE) >= 0.5:
        return s
    unknown = np.full(len(points), -1, dtype=np.int64)
    placed = place(mapped, Survey(unknown, points, site.reflectors.widths), SURVEY_SIGMA)
    if placed.T_survey_map is None:
        raise MapError(f'the map of the run is not found in the layout: {placed.why}')
    T = placed.T_survey_map
    return replace(s, poses=se2.compose(T, s.poses), covs=se2.rotate_cov(s.covs, T[2]))
