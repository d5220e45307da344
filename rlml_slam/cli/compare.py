# SPDX-License-Identifier: Apache-2.0
"""``rlml compare``: two runs of one recording, or two localizations in one bag."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.text_table import aligned
from rlml_slam.datasets.tum import Trajectory, read_tum
from rlml_slam.errors import ParameterError
from rlml_slam.evaluation.run_comparison import FIGURES, compare_runs, limits_with
from rlml_slam.evaluation.run_folder import LIVE, METRICS, RunFolder, read_run
from rlml_slam.recordings.bag_poses import TF, poses_of, poses_on_tf
from rlml_slam.report.comparison_page import figures_of, table_of, text_of, write_comparison
from rlml_slam.ros.bags.bag import BagReader

ERROR_CODE = 2  # 1: there are differences
OURS = ('/shadow/pose', '/pose')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml compare``."""
    parser = subparsers.add_parser(
        'compare',
        help='two runs of one bag: what differs, and where they part',
        description='Compares the results of two replays of one recording (other parameters, '
        'version or system), a trajectory in TUM format, or the poses in a bag, as of AMCL. With '
        'one bag alone, a node in shadow mode is compared with map to base on /tf. Exit code 0 '
        'where nothing differs beyond the limits, 1 where something does, 2 for an error.',
    )
    parser.add_argument('a', metavar='A', type=Path, help='folder of rlml replay, TUM file or bag')
    parser.add_argument('b', metavar='B', type=Path, nargs='?', help='the other one')
    parser.add_argument('--out', type=Path, metavar='DIR', help='write a page and its figures')
    parser.add_argument(
        '--limit', action='append', default=[], metavar='NAME=VALUE',
        help=f'how far a figure may differ, of {", ".join(FIGURES)}; repeat for more',
    )  # fmt: skip
    parser.add_argument(
        '--ours', metavar='TOPIC', default='', help=f'default: {OURS[0]}, else {OURS[1]}'
    )
    parser.add_argument(
        '--other', metavar='TOPIC', default=TF, help='/tf, or poses (default: %(default)s)'
    )
    parser.add_argument('--map-frame', default='map', metavar='FRAME')
    parser.add_argument('--base-frame', default='base_link', metavar='FRAME')
    frame = parser.add_mutually_exclusive_group()
    frame.add_argument('--same-map', action='store_true', help='do not fit: both have one map; '
                       'the default for two runs')  # fmt: skip
    frame.add_argument('--fit', action='store_true', help='fit the path of B to that of A first; '
                       'the default for all others')  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print comparison.json and no more')


def run(args: argparse.Namespace) -> int:
    """Compare, write and print; 1 where something differs."""
    a, b = sides(args)
    of_runs = a.is_run and b.is_run
    limits = limits_with(args.limit, none=not of_runs)
    found = compare_runs(a, b, limits, args.fit or not (of_runs or args.same_map))
    if args.out is not None:
        write_comparison(found, args.out)
    if args.json:
        print(json.dumps(figures_of(found)))
        return int(found.is_different)
    print(text_of(found))
    print()
    print(aligned(table_of(found.rows)))
    beyond = [r.title for r in found.rows if r.is_beyond]
    print()
    print(f'different: {"; ".join(beyond)}' if beyond else 'no difference beyond the limits')
    if args.out is not None:
        print(args.out / 'comparison.html')
    return int(found.is_different)


def sides(args: argparse.Namespace) -> tuple[RunFolder, RunFolder]:
    """A and B; one bag alone has both."""
    if args.b is None:
        if _kind(args.a) != 'bag':
            raise ParameterError(f'compare: {args.a} is no bag: give two runs')
        with BagReader(args.a) as bag:
            ours = args.ours or next((t for t in OURS if t in bag.topics), OURS[0])
            path = poses_of(bag, ours)
            return _other(args, bag, path), RunFolder(ours, {LIVE: path})
    for path in (args.a, args.b):
        if not path.exists():
            raise ParameterError(f'compare: {path}: no such file or folder')
    kinds = _kind(args.a), _kind(args.b)
    if kinds == ('bag', 'bag'):
        raise ParameterError('compare: of two bags at least one has to be replayed first')
    read = {k: _read(p) for k, p in zip('ab', (args.a, args.b), strict=True) if _kind(p) != 'bag'}
    for side, path in (('a', args.a), ('b', args.b)):
        if side not in read:
            known = read['b' if side == 'a' else 'a'].paths
            with BagReader(path) as bag:
                read[side] = _other(args, bag, next(iter(known.values())))
    return read['a'], read['b']


def _kind(path: Path) -> str:
    if path.is_dir() and ((path / METRICS).exists() or not (path / 'metadata.yaml').exists()):
        return 'run'
    return 'tum' if path.suffix in ('.tum', '.txt') else 'bag'


def _read(path: Path) -> RunFolder:
    if _kind(path) == 'run':
        return read_run(path)
    return RunFolder(path.name, {LIVE: read_tum(path)})


def _other(args: argparse.Namespace, bag: BagReader, path: Trajectory) -> RunFolder:
    """The other localization of a bag: on /tf at the stamps of a path, or a topic's own."""
    name = f'{bag.path.name} {args.other}'
    if args.other == TF:
        return RunFolder(name, {LIVE: poses_on_tf(bag, path, args.map_frame, args.base_frame)})
    return RunFolder(name, {LIVE: poses_of(bag, args.other)})
