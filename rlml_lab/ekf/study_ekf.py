# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study ekf``: RLML, the EKF with each extractor and dead reckoning on the same drives.

Three questions: how good is each system on what it will be given (study_ekf_drives), whether its
covariance is consistent where association is no matter (study_ekf_consistency), and what its
parts cost (study_ekf_speed).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlml_lab.ekf import study_ekf_consistency as consistency
from rlml_lab.ekf import study_ekf_drives as drives
from rlml_lab.ekf import study_ekf_speed as speed
from rlml_lab.support.parallel_jobs import add_workers, each, workers_of
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.params import EkfParameters, read_yaml


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study ekf``."""
    parser = subparsers.add_parser(
        'ekf', help='RLML, the EKF with each extractor and dead reckoning on the same drives'
    )
    parser.add_argument('--seeds', type=int, default=5, metavar='N', help='default: %(default)s')
    parser.add_argument('--world', nargs='+', default=['hall', 'room'], metavar='NAME')
    parser.add_argument(
        '--system', nargs='+', default=list(drives.SYSTEMS), choices=drives.SYSTEMS
    )
    parser.add_argument('--duration', type=float, default=0.0, metavar='S', help='0 is all of it')
    parser.add_argument(
        '--consistency-seeds', type=int, metavar='N',
        help='drives with known associations, 0 for none (default: as --seeds)',
    )  # fmt: skip
    parser.add_argument('--config', type=Path, metavar='YAML', help="the systems' parameters")
    add_workers(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='report.html and results.json')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all systems over all drives and print a row per world and system."""
    known = args.seeds if args.consistency_seeds is None else args.consistency_seeds
    workers = workers_of(args)
    if args.seeds < 1 or known < 0:
        raise ParameterError('study ekf: --seeds must be 1 or more')
    began = time.perf_counter()
    values = read_yaml(args.config, EkfParameters) if args.config else {}
    tasks = [
        (w, s, values, tuple(args.system), args.duration)
        for w in args.world
        for s in range(args.seeds)
    ]
    rows: dict[str, dict[str, dict[int, Any]]] = {w: {} for w in args.world}
    with Progress('drives', len(tasks), args.json) as progress:
        for k, (task, figures) in enumerate(each(drives.evaluate_drive, tasks, workers), 1):
            for system, f in figures.items():
                rows[task[0]].setdefault(system, {})[task[1]] = f
            progress.update(k, f'{task[0]}, seed {task[1]}')
    summary: dict[str, Any] = {
        'seeds': args.seeds,
        'drives': {
            f'{world}, {system}': drives.summarize([r[s] for s in sorted(r)])
            for world, systems in rows.items()
            for system, r in systems.items()
        },
    }
    series = consistency.run_all(known, workers, args.json) if known else {}
    summary['consistency'] = {name: s.summary() for name, s in series.items()}
    summary['speed'] = speed.figures()
    summary['wall_s'] = round(time.perf_counter() - began, 1)
    if args.out is not None:
        # matplotlib takes half a second to import, which other commands need not wait for
        from rlml_lab.ekf.study_ekf_report import write_report

        write_report(args.out, summary, series)
    print(json.dumps(summary) if args.json else text(summary))
    return 0


def text(summary: Mapping[str, Any]) -> str:
    """The tables as text."""
    tables = [(drives.HEADER, drives.rows(summary['drives']))]
    if summary['consistency']:
        tables.append((consistency.HEADER, consistency.rows(summary['consistency'])))
    return '\n\n'.join(
        [
            f'{summary["seeds"]} seeds; mean ± deviation (worst)',
            *(aligned([header, *rows]) for header, rows in tables),
            '\n'.join(speed.lines(summary['speed'])),
        ]
    )
