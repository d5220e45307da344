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

from rlml_slam.evaluation.survey_residuals import changes, compare, name_of
from rlml_slam.maps import survey
from rlml_slam.slam.store import map_file


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
    content, surveyed = map_file.load(args.file), survey.load(args.survey)
    own = map_file.survey_of(content)
    in_survey_frame = own is not None and survey.same(own, surveyed)
    figures = compare(map_file.saved_map(content).reflectors, surveyed, in_survey_frame)
    print(json.dumps(figures) if args.json else text(figures))
    return 0


def text(figures: dict[str, Any]) -> str:
    """The figures for people."""
    x, y, theta = figures['T_survey_map']
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
