# SPDX-License-Identifier: Apache-2.0
"""``study worlds``: accuracy and consistency in simulated worlds over many seeds, offline."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.support.parallel_jobs import add_workers, each, workers_of
from rlml_slam import warm_up
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import ParameterError
from rlml_slam.evaluation.metrics import metrics
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping, read_yaml
from rlml_slam.recordings.products import collect
from rlml_slam.report.outputs import write_outputs
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Imu, Level, Odometry, Scan

WORLDS = ('hall', 'corridor', 'symmetric', 'yard')
# figure of metrics.json -> (heading of its column, factor, digits)
COLUMNS = {
    'live_ate_rmse_m': ('live ATE [cm]', 100.0, 2),
    'live_heading_rmse_deg': ('heading [°]', 1.0, 3),
    'nees_mean': ('NEES', 1.0, 2),
    'ate_rmse_m': ('optimised ATE [cm]', 100.0, 2),
    'sigma_max_m': ('largest σ [cm]', 100.0, 1),
    'ok_share': ('OK', 1.0, 3),
}


@dataclass(frozen=True)
class Case:
    """One drive: a world, with or without reflectors, and a seed."""

    world: str
    seed: int
    reflectors: bool = True


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study worlds``."""
    parser = subparsers.add_parser(
        'worlds',
        help='accuracy and consistency over seeds and worlds',
        description='Drives through simulated worlds offline and evaluates the poses as published '
        'live. A consistent pose covariance gives a mean NEES of 3.',
    )
    parser.add_argument('--seeds', type=int, default=10, metavar='N', help='default: %(default)s')
    parser.add_argument(
        '--world', nargs='+', default=list(WORLDS), metavar='NAME',
        help=f'names or world files (default: {" ".join(WORLDS)})',
    )  # fmt: skip
    parser.add_argument('--no-reflectors', action='store_true', help='without any detections')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the system's parameters")
    parser.add_argument(
        '--simulator', type=Path, metavar='YAML', help="the simulator's parameters"
    )
    add_workers(parser)
    parser.add_argument(
        '--out', type=Path, metavar='DIR', help='report of the worst seed of each world'
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all cases and print a row per world."""
    workers = workers_of(args)
    if args.seeds < 1:
        raise ParameterError('study worlds: --seeds must be 1 or more')
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    simulator = read_yaml(args.simulator, SimulatorParameters) if args.simulator else {}
    cases = [
        Case(world, seed, not args.no_reflectors)
        for world in args.world
        for seed in range(args.seeds)
    ]
    with Progress('study', len(cases), args.json) as progress:
        found: dict[Case, dict[str, Any]] = {}
        tasks = [(case, params, simulator) for case in cases]
        for k, ((case, *_), figures) in enumerate(each(evaluate_case, tasks, workers), 1):
            found[case] = figures
            error = 100 * figures['live_ate_rmse_m']
            progress.update(k, f'{case.world}, seed {case.seed}: {error:.1f} cm')
    results = {w: [found[case] for case in cases if case.world == w] for w in args.world}
    summary = {world: summarize(rows) for world, rows in results.items()}
    if args.out is not None:
        for world, s in summary.items():
            case = Case(world, s['worst_seed'], not args.no_reflectors)
            write_outputs(drive(case, params, simulator), args.out / Path(world).stem)
    if args.json:
        print(json.dumps(summary))
    else:
        print(table(summary))
    return 0


def drive(case: Case, params: Parameters, simulator: Mapping[str, Any] | None = None) -> Run:
    """Simulate one drive and run the system over what the sensors say."""
    p: SimulatorParameters = from_mapping(
        {**(simulator or {}), 'world': case.world}, SimulatorParameters
    )
    p = replace(p, markers=replace(p.markers, enabled=p.markers.enabled and case.reflectors))
    simulation = Simulation(load_world(p.node.world), p, case.seed)
    slam, log = Slam(params), FrameLog()
    warm_up.compile_loaded()
    slam.set_sensor_pose(p.node.laser_frame, np.array(p.node.laser_pose))
    stamps: list[int] = []
    poses = []
    for event in simulation:
        message = event.message
        if isinstance(message, GroundTruth):
            stamps.append(message.stamp)
            poses.append(message.T_map_base)
        elif isinstance(message, Odometry):
            log.add(slam.add_odometry(message))
        elif isinstance(message, Imu):
            log.add(slam.add_imu(message))
        elif isinstance(message, Scan):
            log.add(slam.add_scan(message))
        else:
            log.add(slam.add_detections(message))
    log.add(slam.finish())
    points, ids = simulation.true_reflectors()
    true_path = Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))
    truth = Truth(true_path, True, ids, points)
    result = collect(slam, log, f'{case.world}, seed {case.seed}', truth)
    result.inputs = slam.counts
    return result


def evaluate_case(
    case: Case, params: Parameters, simulator: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Figures of one drive: those of metrics.json, largest sigma, and what was not OK and why."""
    result = drive(case, params, simulator)
    covs = np.array(result.frames.covs)
    reasons: Counter[str] = Counter()
    for level, why in zip(result.frames.levels, result.frames.reasons, strict=True):
        if level != Level.OK:
            reasons.update(why)
    sigmas = np.sqrt(np.linalg.eigvalsh(covs[:, :2, :2])[:, 1])
    return {
        **metrics(result),
        'seed': case.seed,
        'sigma_max_m': float(sigmas.max()),
        'sigma_last_m': float(sigmas[-1]),
        'ok_share': result.health_share()['OK'],
        'reasons': dict(reasons.most_common(5)),
    }


def summarize(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean, standard deviation and extremes of each figure over the seeds of one world."""
    out: dict[str, Any] = {'seeds': len(rows), 'scans': int(sum(r['scans'] for r in rows))}
    for key in COLUMNS:
        v = np.array([r.get(key, np.nan) for r in rows])
        out[key] = {
            'mean': float(v.mean()), 'std': float(v.std()),
            'min': float(v.min()), 'max': float(v.max()),
        }  # fmt: skip
    out['worst_seed'] = max(rows, key=lambda r: float(r['live_ate_rmse_m']))['seed']
    reasons: Counter[str] = Counter()
    for r in rows:
        reasons.update(r['reasons'])
    out['reasons'] = dict(reasons.most_common(5))
    out['per_seed'] = [{k: r.get(k) for k in ('seed', *COLUMNS)} for r in rows]
    return out


def table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """A row per world: mean ± std (max) of each figure; then why it was not OK."""
    cells = [['world', *(title for title, _, _ in COLUMNS.values()), 'worst seed']]
    for world, s in summary.items():
        row = [world]
        for key, (_, unit, digits) in COLUMNS.items():
            v = {k: unit * x for k, x in s[key].items()}
            extreme = v['min'] if key == 'ok_share' else v['max']
            row.append(f'{v["mean"]:.{digits}f} ± {v["std"]:.{digits}f} ({extreme:.{digits}f})')
        cells.append([*row, str(s['worst_seed'])])
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    lines = [
        '  '.join(f'{c:<{w}}' for c, w in zip(row, widths, strict=True)).rstrip() for row in cells
    ]
    lines.append('mean ± standard deviation over the seeds (worst)')
    for world, s in summary.items():
        for reason, count in s['reasons'].items():
            lines.append(f'{world}: {count} × {reason}')
    return '\n'.join(lines)
