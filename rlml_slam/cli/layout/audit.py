# SPDX-License-Identifier: Apache-2.0
"""``rlml audit``: what of a commissioned layout is not as planned, and what to do about it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rlml_slam.cli.layout.plan import sensor_of
from rlml_slam.cli.replay import load_known
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.datasets.tum import read_tum
from rlml_slam.errors import MapError, ParameterError
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.audit import sightings as record
from rlml_slam.planning.audit.audit import in_frame_of, make_audit
from rlml_slam.planning.plan import Goal, figures, make_plan
from rlml_slam.planning.site import Site
from rlml_slam.planning.site_file import read_plan
from rlml_slam.recordings.bag_replay import Given, replay
from rlml_slam.report.audit_page import area_rows, finding_rows, write_audit
from rlml_slam.report.outputs import SIGHTINGS, write_outputs
from rlml_slam.se2 import Array

ERROR_CODE = 2  # 1: there are findings
SPACING = 0.5  # [m] of places along the run, where there is no plan


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml audit``."""
    parser = subparsers.add_parser(
        'audit',
        help='a run against its planned layout: what is not as planned',
        description='Reflectors that were moved, hidden, turned or are dirty, ghosts and the '
        'walls that mirror them, places where the robot was DEGRADED, and accuracy against the '
        'plan, area by area. Exit code 0 without findings, 1 with findings, 2 for an error.',
    )
    parser.add_argument('run', metavar='RUN', type=Path, help='folder of rlml replay, or a bag, '
                        'which is replayed in the map of the plan first')  # fmt: skip
    parser.add_argument('--plan', type=Path, metavar='DIR', help='folder of rlml plan; without '
                        "it, the run's own map is the plan")  # fmt: skip
    parser.add_argument('--out', type=Path, metavar='DIR', help='default: RUN/audit, or audit '
                        'beside a bag')  # fmt: skip
    parser.add_argument('--sensor', type=Path, metavar='YAML', help='as in rlml plan')
    parser.add_argument(
        '--tolerance', type=float, default=0.005, metavar='M',
        help='sigma of the places of the layout [m] (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print audit.json and no more')


def run(args: argparse.Namespace) -> int:
    """Audit, write, print; 1 where something was found."""
    if not 0.0 <= args.tolerance <= 1.0:
        raise ParameterError('--tolerance is not between 0 and 1 m')
    p, sensor = sensor_of(args.sensor)
    planned = None if args.plan is None else read_plan(args.plan)
    folder, out = _replayed(args, p, planned[0] if planned else None)
    s = record.load(folder / SIGHTINGS)
    mapped = load_known(folder)
    if planned is None:
        site = _own_site(folder, mapped)
        plan = _own_plan(site, folder, p, sensor)
    else:
        site, plan = planned
        s = in_frame_of(site, s, mapped.reflectors)
    audit = make_audit(site, s, plan, p, sensor, args.tolerance)
    write_audit(audit, args.run.name, out)
    if args.json:
        print(json.dumps(audit.figures))
    else:
        print(aligned(area_rows(audit.figures)))
        print()
        print(aligned(finding_rows(audit.figures)) if audit.findings else 'all is as planned')
        print(out / 'audit.html')
    return 1 if audit.findings else 0


def _replayed(args: argparse.Namespace, p: Parameters, site: Site | None) -> tuple[Path, Path]:
    """The folder of the run, where a bag is replayed first, and the one for results."""
    path: Path = args.run
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        return path, args.out or path / 'audit'
    if not path.exists():
        raise MapError(f'{path}: neither the folder of a replay nor a bag')
    out = args.out or path.parent / 'audit'
    given = Given() if site is None else Given(known=SavedMap(sites.known(site), site.grid))
    with Progress('replay', 1.0, args.json) as progress:
        result = replay(path, p, given=given, progress=progress.update)
    write_outputs(result, out / 'run')
    return out / 'run', out


def _own_site(folder: Path, mapped: SavedMap) -> Site:
    if mapped.grid is None:
        raise MapError(f'{folder}: the run has no grid; audit needs --plan')
    return sites.of_grid(mapped.grid, mapped.reflectors)


def _own_plan(
    site: Site, folder: Path, p: Parameters, sensor: SimulatorParameters
) -> dict[str, Any]:
    """The plan of the places that the robot was at."""
    path: Array = read_tum(folder / 'trajectory.tum').poses
    places = sites.on_path(path, SPACING)[:, :2]
    return figures(make_plan(site, places, p, sensor, Goal(0.01, 1.0, 0)))
