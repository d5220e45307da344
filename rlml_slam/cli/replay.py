# SPDX-License-Identifier: Apache-2.0
"""``rlml replay``: a bag through the system, without topics and the same from run to run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import read_tum
from rlml_slam.errors import ParameterError
from rlml_slam.evaluation.metrics import run_errors
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.maps import saved_map, survey
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters, from_mapping, read_yaml
from rlml_slam.recordings.bag_replay import SYSTEMS, Given, replay
from rlml_slam.recordings.incident import recorded_parameters
from rlml_slam.recordings.origin import source_of
from rlml_slam.report.outputs import make_folder, write_outputs
from rlml_slam.report.summary import print_summary
from rlml_slam.slam.store import map_file


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml replay``."""
    parser = subparsers.add_parser(
        'replay', help='run the system over a bag: no topics, deterministic'
    )
    parser.add_argument(
        'bag', metavar='BAG', type=Path, help='rosbag2 folder (sqlite3, mcap) or ROS 1 .bag'
    )
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='results go here')
    parser.add_argument('--config', metavar='YAML', type=Path, help='ROS parameter file')
    parser.add_argument(
        '--system', choices=sorted(SYSTEMS), default='rlml', help='default: %(default)s'
    )
    parser.add_argument(
        '--truth', metavar='TUM', type=Path, help='ground truth, aligned before it is compared'
    )
    parser.add_argument(
        '--map', metavar='MAP', type=Path,
        help='localize in this map: a .rlml file, a .yaml file of nav2, or a folder that a replay '
        'wrote or save_map as `map`',
    )  # fmt: skip
    parser.add_argument(
        '--continue', metavar='MAP', type=Path, dest='go_on',
        help='go on mapping with this .rlml file',
    )  # fmt: skip
    parser.add_argument(
        '--survey', metavar='FILE', type=Path,
        help='surveyed reflectors (.csv, .json, SICK .imk): their frame becomes that of the map',
    )  # fmt: skip
    parser.add_argument(
        '--no-odometry', action='store_true', help='leave out the odometry: as use_odom false'
    )
    parser.add_argument(
        '--mcap', metavar='FILE', type=Path,
        help='inputs and estimates as one file for Foxglove, RViz and others',
    )  # fmt: skip
    parser.add_argument('--no-report', action='store_true', help='no report.html')
    parser.add_argument('--json', action='store_true', help='print metrics.json and no more')


def run(args: argparse.Namespace) -> int:
    """Replay, write the results, and say what they are."""
    kind = SYSTEMS[args.system][0]
    params = from_mapping(read_yaml(args.config, kind), kind) if args.config else kind()
    if not args.config and kind is Parameters:
        # an incident says how it was recorded, and where the robot was
        params = recorded_parameters(args.bag) or params
    if args.no_odometry:
        params = replace(params, node=replace(params.node, use_odom=False))
    make_folder(args.out)  # before the work, not after it
    truth = Truth(read_tum(args.truth), is_map=False) if args.truth else None
    if args.map and (args.go_on or args.survey):
        raise ParameterError('replay: --map excludes --continue and --survey')
    for name, option in unused(args, params):
        print(f'rlml: {name} is for the nodes, and is not used: give {option}', file=sys.stderr)
    known = load_known(args.map) if args.map else None
    begun = map_file.load(args.go_on) if args.go_on else None
    surveyed = survey.load(args.survey) if args.survey else None
    with Progress('replay', 1.0, args.json) as progress:
        result = replay(
            args.bag,
            params,
            truth,
            args.system,
            Given(known, begun, surveyed),
            args.mcap,
            progress.update,
        )
    source = source_of(args.bag)
    result.origin = replace(result.origin, command=args.command_line, source=source)
    if truth and run_errors(result) is None and not result.problem:
        result.problem = f'{args.truth}: no errors: it has nothing at the stamps of this bag'
    figures = write_outputs(result, args.out, not args.no_report, args.map)
    return print_summary(result, figures, args.out, args.json, not args.no_report)


def unused(args: argparse.Namespace, params: Any) -> Iterator[tuple[str, str]]:
    """Parameters that say which map or survey a node begins with, and the options of a replay."""
    if not isinstance(params, Parameters):
        return
    if params.back_end.survey and not args.survey and not args.map:
        yield 'back_end.survey', '--survey FILE'
    if params.node.continue_map and not args.go_on and not args.map:
        yield 'continue_map', '--continue MAP'


def load_known(path: Path) -> SavedMap:
    """A map to localize in: a .rlml file, a .yaml of nav2 or a .csv of reflectors, a folder."""
    if (path / 'map.rlml').exists():
        path /= 'map.rlml'  # as the nodes: the text beside it may be older than a --revoke
    if path.suffix in ('.yaml', '.csv') or path.is_dir():
        return saved_map.require_contents(saved_map.load(path), f'{path}: {saved_map.EMPTY}')
    content = map_file.load(path)
    if note := saved_map.newer_image(path):
        print(f'rlml: {note}', file=sys.stderr)
    whole = map_file.saved_map(content)
    return saved_map.require_contents(whole, f'{path}: {saved_map.EMPTY}')
