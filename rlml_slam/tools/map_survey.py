# SPDX-License-Identifier: Apache-2.0
"""``rlml map survey``: the reflectors of a saved map against where they were surveyed.

The map's frame is found in the plant's by the constellation of all reflectors, ids do not count.
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
from rlml_slam.matching.constellation import locate
from rlml_slam.params import Relocalization
from rlml_slam.rlml import stored_map
from rlml_slam.tools.ate import align
from rlml_slam.types import Reflectors, Verdict

SIGMA = 0.05  # [m] a survey and a map may differ by this besides what the map states
MATCH = 4.0  # sigmas within which a reflector of the map is one of the survey
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
    known = stored_map.saved_map(stored_map.load(args.file))
    figures = compare(known.reflectors, survey.load(args.survey))
    print(json.dumps(figures) if args.json else text(figures))
    return 0


def compare(found: Reflectors, surveyed: Survey) -> dict[str, Any]:
    """Residuals, and what is missing, new or moved. Raises MapError where nothing tells the place.

    ``T_plant_map`` makes the sum of the squared residuals as small as it can be.
    """
    cov = np.tile(SIGMA**2 * np.eye(2), (len(surveyed.points), 1, 1))
    place = locate(found.points, found.cov, surveyed.points, cov, Relocalization())
    if place.verdict is not Verdict.UNIQUE:
        raise MapError(f'the map is not found in the survey: {place.why}')
    T, pairs = place.candidates[0].pose, np.zeros((0, 2), dtype=np.int64)
    for _ in range(5):  # the first pairs may lack some at the edge, where a turn counts most
        there = se2.transform(T, found.points)
        gap = np.linalg.norm(there[:, None] - surveyed.points[None], axis=-1)
        sigma = np.sqrt(np.linalg.eigvalsh(found.cov)[:, -1] + SIGMA**2)
        near = (gap < MATCH * sigma[:, None]) & (gap == gap.min(axis=0))
        near &= gap == gap.min(axis=1)[:, None]
        pairs = np.argwhere(near)
        T = align(found.points[pairs[:, 0]], surveyed.points[pairs[:, 1]])
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


def text(figures: dict[str, Any]) -> str:
    """The figures for people; a reflector without an id is named by its row, #1 the first."""

    def name(row: dict[str, Any]) -> str:
        return str(row['id']) if row['id'] >= 0 else f'#{row["survey"] + 1}'

    x, y, theta = figures['T_plant_map']
    lines = [
        f'the map lies at x = {x:.4f} m, y = {y:.4f} m, {math.degrees(theta):.3f}° in the survey',
        f'{len(figures["residuals"])} reflectors, RMSE {1e3 * figures["rmse_m"]:.1f} mm',
        'reflector  key  dx [mm]  dy [mm]  error [mm]',
    ]
    for r in figures['residuals']:
        lines.append(
            f'{name(r):>9} {r["key"]:4d} {1e3 * r["dx_m"]:8.1f} {1e3 * r["dy_m"]:8.1f} '
            f'{1e3 * r["error_m"]:11.1f}'
        )
    for r in figures['moved']:
        lines.append(f'moved: {name(r)} by {r["by_m"]:.2f} m, in the map as {r["key"]}')
    for r in figures['missing']:
        lines.append(f'missing: {name(r)} at {r["at"][0]:.2f}, {r["at"][1]:.2f}')
    for r in figures['new']:
        seen = f'seen {r["sightings"]} times'
        lines.append(f'new: {r["key"]} of the map at {r["at"][0]:.2f}, {r["at"][1]:.2f}, {seen}')
    return '\n'.join(lines)
