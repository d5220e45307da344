# SPDX-License-Identifier: Apache-2.0
"""The reflectors of a map against a survey: residuals, and which are missing, new or moved."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.survey_alignment import pairs_at, place
from rlml_slam.types import Reflectors

SIGMA = 0.05  # [m] a survey and a map may differ by this besides what the map states
MOVED = 3.0  # [m] one that is missing and one that is new are one that was moved, if this near


def compare(found: Reflectors, surveyed: Survey, in_survey_frame: bool = False) -> dict[str, Any]:
    """Residuals, and what is missing, new or moved. Raises MapError if no pose fits.

    ``T_survey_map`` makes the sum of the squared residuals as small as it can be; a map that is
    ``in_survey_frame`` is not moved.
    """
    if in_survey_frame:
        T, pairs = np.zeros(3), pairs_at(found, surveyed, np.zeros(3), SIGMA)
        if not len(pairs):
            raise MapError('no reflector of the map is where one was surveyed')
    else:
        placed = place(found, surveyed, SIGMA)
        if placed.T_survey_map is None:
            raise MapError(f'the map is not found in the survey: {placed.why}')
        T, pairs = placed.T_survey_map, placed.pairs
    there = se2.transform(T, found.points)
    d = there[pairs[:, 0]] - surveyed.points[pairs[:, 1]]
    extra = np.setdiff1d(np.arange(len(found)), pairs[:, 0])
    lost = np.setdiff1d(np.arange(len(surveyed.points)), pairs[:, 1])
    moved, extra_left, lost_left = [], set(extra.tolist()), set(lost.tolist())
    gaps = np.linalg.norm(there[extra][:, None] - surveyed.points[lost][None], axis=-1)
    for a, b in sorted(np.argwhere(gaps < MOVED).tolist(), key=lambda ab: gaps[ab[0], ab[1]]):
        i, k = int(extra[a]), int(lost[b])
        if i in extra_left and k in lost_left:
            extra_left.remove(i)
            lost_left.remove(k)
            moved.append({'survey': k, 'id': int(surveyed.ids[k]), 'key': int(found.keys[i]),
                          'by_m': float(gaps[a, b])})  # fmt: skip
    return {
        'T_survey_map': T.tolist(),
        'rmse_m': float(np.sqrt((d**2).sum(-1).mean())),
        'residuals': [
            {'survey': int(k), 'id': int(surveyed.ids[k]), 'key': int(found.keys[i]),
             'dx_m': float(e[0]), 'dy_m': float(e[1]), 'error_m': float(np.hypot(*e))}
            for (i, k), e in sorted(zip(pairs.tolist(), d, strict=True), key=lambda r: r[0][1])
        ],
        'missing': [
            {'survey': k, 'id': int(surveyed.ids[k]), 'at': surveyed.points[k].tolist()}
            for k in sorted(lost_left)
        ],
        'new': [
            {'key': int(found.keys[i]), 'at': there[i].tolist(),
             'sightings': int(found.sightings[i])}
            for i in sorted(extra_left)
        ],
        'moved': moved,
    }  # fmt: skip


def name_of(row: dict[str, Any]) -> str:
    """What a surveyed reflector is called; one without an id by its row, #1 the first."""
    return str(row['id']) if row['id'] >= 0 else f'#{row["survey"] + 1}'


def changes(figures: dict[str, Any]) -> list[str]:
    """A line per reflector that is not where it was surveyed, or was not surveyed."""
    lines = []
    for r in figures['moved']:
        lines.append(f'moved: {name_of(r)} by {r["by_m"]:.2f} m, in the map as {r["key"]}')
    for r in figures['missing']:
        lines.append(f'missing: {name_of(r)} at {r["at"][0]:.2f}, {r["at"][1]:.2f}')
    for r in figures['new']:
        seen = f'seen {r["sightings"]} times'
        lines.append(f'new: {r["key"]} of the map at {r["at"][0]:.2f}, {r["at"][1]:.2f}, {seen}')
    return lines
