# SPDX-License-Identifier: Apache-2.0
"""``rlml map survey``: the reflectors of a saved map against where they were surveyed.

The map's frame is found in the plant's by ids or by the constellation of all reflectors, unless
the map was made in it.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps import survey
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.plant import pairs_at, place
from rlml_slam.rlml import stored_map
from rlml_slam.types import Reflectors

SIGMA = 0.05  # [m] a survey and a map may differ by this besides what the map states
MOVED = 3.0  # [m] one that is missing and one that is new are one that was moved, if this near


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map survey``."""
    parser = subparsers.add_parser(
        'survey',
        help='reflectors of a saved map against where they were surveyed',
        description='Prints the pose of the map in the frame of the survey, the residual of each '
        'reflector, and which are missing, new or moved.',
    )
    parser.add_argument('file', metavar='FILE', type=Path, help='map.rlml')
    parser.add_argument('survey', metavar='SURVEY', type=Path, help='.csv, .json or SICK .imk')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Compare and print."""
    content, surveyed = stored_map.load(args.file), survey.load(args.survey)
    own = stored_map.survey_of(content)
    in_plant = own is not None and survey.same(own, surveyed)
    figures = compare(stored_map.saved_map(content).reflectors, surveyed, in_plant)
    print(json.dumps(figures) if args.json else text(figures))
    return 0


def compare(found: Reflectors, surveyed: Survey, in_plant: bool = False) -> dict[str, Any]:
    """Residuals, and what is missing, new or moved. Raises MapError where nothing tells the place.

    ``T_plant_map`` makes the sum of the squared residuals as small as it can be; a map that is
    ``in_plant``, in the frame of the survey, is not moved.
    """
    if in_plant:
        T, pairs = np.zeros(3), pairs_at(found, surveyed, np.zeros(3), SIGMA)
        if not len(pairs):
            raise MapError('no reflector of the map is where one was surveyed')
    else:
        placed = place(found, surveyed, SIGMA)
        if placed.T_plant_map is None:
            raise MapError(f'the map is not found in the survey: {placed.why}')
        T, pairs = placed.T_plant_map, placed.pairs
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
        'T_plant_map': T.tolist(),
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


def text(figures: dict[str, Any]) -> str:
    """The figures for people."""
    x, y, theta = figures['T_plant_map']
    lines = [
        f'the map lies at x = {x:.4f} m, y = {y:.4f} m, {math.degrees(theta):.3f}° in the survey',
        f'{len(figures["residuals"])} reflectors, RMSE {1e3 * figures["rmse_m"]:.1f} mm',
        'reflector  key  dx [mm]  dy [mm]  error [mm]',
    ]
    for r in figures['residuals']:
        lines.append(
            f'{name_of(r):>9} {r["key"]:4d} {1e3 * r["dx_m"]:8.1f} {1e3 * r["dy_m"]:8.1f} '
            f'{1e3 * r["error_m"]:11.1f}'
        )
    return '\n'.join([*lines, *changes(figures)])


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
