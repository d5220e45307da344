# SPDX-License-Identifier: Apache-2.0
"""``rlml study ekf``: RLML, the EKF with each extractor and dead reckoning on the same drives.

Two questions: how good is each system on what it will be given, and whether its covariance tells
the truth where association is no matter (study_ekf_consistency).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.ekf.models import POINT
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import ParameterError
from rlml_slam.params import EkfParameters, SimulatorParameters, from_mapping, read_yaml
from rlml_slam.rlml.slam import Slam
from rlml_slam.simulation.simulation import Message
from rlml_slam.tools import study_ekf_consistency as consistency
from rlml_slam.tools.association_truth import AssociationLog, association_figures
from rlml_slam.tools.ate import trajectory_errors
from rlml_slam.tools.drives import feed, simulate
from rlml_slam.tools.metrics import metrics
from rlml_slam.tools.progress import Progress
from rlml_slam.tools.record import FrameLog
from rlml_slam.tools.replay import collect
from rlml_slam.tools.study_jobs import each
from rlml_slam.tools.tum import Trajectory
from rlml_slam.types import Odometry

SYSTEMS = ('rlml', 'reflectors', 'spikes', 'lines', 'dead_reckoning')
# figure -> heading of its column, factor and digits
COLUMNS: dict[str, tuple[str, float, int]] = {
    'ate_rmse_m': ('ATE [cm]', 100.0, 2),
    'live_ate_rmse_m': ('live [cm]', 100.0, 2),
    'heading_rmse_deg': ('heading [°]', 1.0, 3),
    'landmark_rmse_m': ('landmarks [cm]', 100.0, 2),
    'nees_mean': ('NEES (3)', 1.0, 2),
    'precision': ('precision [%]', 100.0, 2),
    'recall': ('recall [%]', 100.0, 2),
    'median_ms': ('median [ms]', 1.0, 2),
    'p99_ms': ('p99 [ms]', 1.0, 2),
}


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml study ekf``."""
    parser = subparsers.add_parser(
        'ekf', help='RLML, the EKF with each extractor and dead reckoning on the same drives'
    )
    parser.add_argument('--seeds', type=int, default=5, metavar='N', help='default: %(default)s')
    parser.add_argument('--world', nargs='+', default=['hall', 'room'], metavar='NAME')
    parser.add_argument('--system', nargs='+', default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument('--duration', type=float, default=0.0, metavar='S', help='0 is all of it')
    parser.add_argument(
        '--consistency-seeds', type=int, metavar='N',
        help='drives with known associations, 0 for none (default: as --seeds)',
    )  # fmt: skip
    parser.add_argument('--config', type=Path, metavar='YAML', help="the systems' parameters")
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--out', type=Path, metavar='DIR', help='report.html and results.json')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all systems over all drives and print a row per world and system."""
    known = args.seeds if args.consistency_seeds is None else args.consistency_seeds
    if args.seeds < 1 or args.jobs < 1 or known < 0:
        raise ParameterError('study ekf: --seeds and --jobs must be 1 or more')
    began = time.perf_counter()
    values = read_yaml(args.config) if args.config else {}
    tasks = [
        (w, s, values, tuple(args.system), args.duration)
        for w in args.world
        for s in range(args.seeds)
    ]
    rows: dict[str, dict[str, dict[int, Any]]] = {w: {} for w in args.world}
    with Progress('drives', len(tasks), args.json) as progress:
        for k, (task, figures) in enumerate(each(judge_drive, tasks, args.jobs), 1):
            for system, f in figures.items():
                rows[task[0]].setdefault(system, {})[task[1]] = f
            progress.update(k, f'{task[0]}, seed {task[1]}')
    summary: dict[str, Any] = {
        'seeds': args.seeds,
        'drives': {
            f'{world}, {system}': summarize([r[s] for s in sorted(r)])
            for world, systems in rows.items()
            for system, r in systems.items()
        },
    }
    series = consistency.run_all(known, args.jobs, args.json) if known else {}
    summary['consistency'] = {name: s.summary() for name, s in series.items()}
    summary['wall_s'] = round(time.perf_counter() - began, 1)
    if args.out is not None:
        from rlml_slam.tools.study_ekf_report import write_report

        write_report(args.out, summary, series)
    print(json.dumps(summary) if args.json else text(summary))
    return 0


def judge_drive(
    world: str, seed: int, values: Mapping[str, Any], systems: Sequence[str], duration: float
) -> dict[str, dict[str, Any]]:
    """Figures of each system on one simulated drive."""
    p: SimulatorParameters = from_mapping(
        {'world': world, 'duration': duration}, SimulatorParameters
    )
    messages, truth = simulate(p, seed)
    params: EkfParameters = from_mapping(values, EkfParameters)
    out: dict[str, dict[str, Any]] = {}
    for system in systems:
        if system == 'dead_reckoning':
            out[system] = dead_reckoning(messages, truth.trajectory)
            continue
        slam: Slam | EkfSlam = Slam(params)
        if system != 'rlml':
            slam = EkfSlam(replace(params, ekf=replace(params.ekf, extractor=system)))
        slam.set_sensor_pose(p.node.laser_frame, np.array(p.node.laser_pose))
        log, associations = FrameLog(), AssociationLog()
        for frames in feed(slam, messages):
            log.add(frames)
            associations.add(frames)
        model = slam.estimator.model if isinstance(slam, EkfSlam) else POINT
        figures = metrics(collect(slam, log, f'{world}, {system}', truth))
        figures |= association_figures(associations, truth.trajectory, slam.reflectors(), model)
        figures |= {f'{k}_ms': figures['front_end_ms'][k] for k in ('median', 'p99')}
        out[system] = {k: figures.get(k) for k in COLUMNS}
    return out


def dead_reckoning(messages: Sequence[Message], truth: Trajectory) -> dict[str, Any]:
    """Errors of the odometry alone, which begins at the truth's start."""
    odometry = [m for m in messages if isinstance(m, Odometry)]
    poses = se2.between(odometry[0].pose, np.array([o.pose for o in odometry]))
    stamps = np.array([o.stamp for o in odometry], dtype=np.int64)
    errors = trajectory_errors(Trajectory(stamps, poses), truth).summary()
    return {
        'ate_rmse_m': errors['rmse_m'],
        'live_ate_rmse_m': errors['rmse_m'],
        'heading_rmse_deg': errors['heading_rmse_deg'],
    }


def summarize(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean, worst and values of each figure over the seeds that have it, None where none has."""
    out: dict[str, Any] = {}
    for key in COLUMNS:
        values = [None if r.get(key) is None else float(r[key]) for r in rows]
        known = [v for v in values if v is not None]
        worst = min if key in ('precision', 'recall') else max
        out[key] = {
            'mean': float(np.mean(known)) if known else None,
            'worst': worst(known) if known else None,
            'per_seed': values,
        }
    return out


def text(summary: Mapping[str, Any]) -> str:
    """The tables as text."""
    tables = [(['world, system', *(c[0] for c in COLUMNS.values())], drive_rows(summary))]
    if summary['consistency']:
        tables.append((consistency.HEADER, consistency.rows(summary['consistency'])))
    lines = [f'{summary["seeds"]} seeds; mean (worst)']
    for header, rows in tables:
        cells = [header, *rows]
        widths = [max(len(r[k]) for r in cells) for k in range(len(header))]
        lines += ['  '.join(c.ljust(w) for c, w in zip(r, widths, strict=True)) for r in cells]
        lines.append('')
    return '\n'.join(lines)


def drive_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """A row of cells per world and system."""
    out = []
    for name, figures in summary['drives'].items():
        row = [name]
        for key, (_, factor, digits) in COLUMNS.items():
            mean, worst = figures[key]['mean'], figures[key]['worst']
            row.append(
                '-' if mean is None
                else f'{factor * mean:.{digits}f} ({factor * worst:.{digits}f})'
            )  # fmt: skip
        out.append(row)
    return out
