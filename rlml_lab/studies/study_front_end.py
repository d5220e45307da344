# SPDX-License-Identifier: Apache-2.0
"""``study front-end``: what each sensor is worth, what faults cost, whether sigma is true.

Poses are evaluated as published live. Every system of a drive is given the same messages; a fault
leaves all other noise of its seed as it was. Carried robots are evaluated by how long they take to
know that they are lost, and where they are.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from rlml_lab.studies.front_end_tables import (
    COLUMNS,
    FAULT_HEADER,
    FAULTS,
    SENSORS,
    drive_rows,
    fault_rows,
    kidnap_text,
)
from rlml_lab.support.drives import feed, simulate
from rlml_lab.support.parallel_jobs import add_workers, each, workers_of
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import ParameterError
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import nees
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping, read_yaml
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START, Message
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Detections, Frame, Level, Scan

WORLDS = ('hall', 'corridor', 'symmetric', 'yard')
# false detections per scan that are half of all
VISIBLE = {'hall': 6.0, 'corridor': 3.3, 'symmetric': 5.7, 'yard': 9.9}
DROPOUT, EVERY = 0.5, 10.0  # [s] without scan and reflectors, and from one to the next
INSIDE = float(chi2.ppf(0.95, 3))
KIDNAPPED = (55.0, 85.0)  # [s] when a robot is carried away, somewhere on its way so far


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study front-end``."""
    parser = subparsers.add_parser(
        'front-end', help='each sensor alone and together, faults, kidnapping'
    )
    parser.add_argument('--seeds', type=int, default=5, metavar='N', help='default: %(default)s')
    parser.add_argument('--world', nargs='+', default=list(WORLDS), choices=WORLDS)
    parser.add_argument('--sensors', nargs='+', default=list(SENSORS), choices=list(SENSORS))
    parser.add_argument('--fault', nargs='*', default=list(FAULTS), choices=FAULTS)
    parser.add_argument(
        '--kidnaps',
        type=int,
        metavar='N',
        help='carried robots, in the hall (default: as --seeds)',
    )
    parser.add_argument('--config', type=Path, metavar='YAML', help="the system's parameters")
    add_workers(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='report.html and results.json')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all drives and print the tables."""
    kidnaps = args.seeds if args.kidnaps is None else args.kidnaps
    workers = workers_of(args)
    if args.seeds < 1 or kidnaps < 0:
        raise ParameterError('study front-end: --seeds must be 1 or more, --kidnaps not below 0')
    began = time.perf_counter()
    values = read_yaml(args.config) if args.config else {}
    tasks = [
        (world, fault, seed, tuple(args.sensors) if not fault else ('both',), values)
        for world in args.world
        for fault in ('', *args.fault)
        for seed in range(args.seeds)
    ]
    rows: dict[str, dict[int, dict[str, float]]] = {}
    with Progress('drives', len(tasks), args.json) as progress:
        for k, (task, figures) in enumerate(each(evaluate_drive, tasks, workers), 1):
            for sensors, f in figures.items():
                rows.setdefault(f'{task[0]}, {task[1] or sensors}', {})[task[2]] = f
            progress.update(k, f'{task[0]}, {task[1] or "clean"}, seed {task[2]}')
    summary: dict[str, Any] = {
        'seeds': args.seeds,
        'drives': {name: summarize([r[s] for s in sorted(r)]) for name, r in rows.items()},
    }
    summary['robustness'] = robustness(summary['drives'])
    with Progress('kidnaps', kidnaps, args.json) as progress:
        carried = []
        for k, (_, f) in enumerate(
            each(evaluate_kidnap, [(seed, values) for seed in range(kidnaps)], workers), 1
        ):
            carried.append(f)
            progress.update(k, f'found after {f["found_s"]} s')
    summary['kidnaps'] = carried
    summary['wall_s'] = round(time.perf_counter() - began, 1)
    if args.out is not None:
        from rlml_lab.studies.front_end_report import write_report

        write_report(args.out, summary)
    print(json.dumps(summary) if args.json else text(summary))
    return 0


def parameters_of(world: str, fault: str) -> SimulatorParameters:
    """The simulator with one fault; a dropout is not a matter of the simulator."""
    faults: dict[str, dict[str, float]] = {
        'slip': {'wheels.slip_rate': 0.1},  # bursts of 0.5 s: 5 % of the time
        'worn': {'wheels.speed_scale': 0.96, 'wheels.turn_scale': 1.05},  # all the way
        'ghosts': {'markers.false_detections': VISIBLE[world]},
        'missed': {'markers.missed_share': 0.4},
        'jitter': {'transport.jitter': 0.02},
    }
    p: SimulatorParameters = from_mapping(
        {'world': world, **faults.get(fault, {})}, SimulatorParameters
    )
    return p


def without_dropouts(messages: Sequence[Message]) -> list[Message]:
    """The messages less scans and detections of the first DROPOUT of each EVERY seconds."""

    def falls(stamp: int) -> bool:
        since = (stamp - START) / SECOND
        return since > EVERY and since % EVERY < DROPOUT

    return [m for m in messages if not (isinstance(m, Scan | Detections) and falls(m.stamp))]


def system(p: SimulatorParameters, values: Mapping[str, Any], sensors: str = 'both') -> Slam:
    """A system with some of its sensors, for a robot of the simulator."""
    slam = Slam(from_mapping({**values, **SENSORS[sensors]}, Parameters))
    slam.set_sensor_pose(p.node.laser_frame, np.array(p.node.laser_pose))
    return slam


def evaluate_drive(
    world: str, fault: str, seed: int, sensors: Sequence[str], values: Mapping[str, Any]
) -> dict[str, dict[str, float]]:
    """Figures of each system on one drive."""
    p = parameters_of(world, fault)
    messages, truth = simulate(p, seed)
    if fault == 'dropout':
        messages = without_dropouts(messages)
    out = {}
    for name in sensors:
        frames = [f for some in feed(system(p, values, name), messages) for f in some]
        out[name] = figures_of(frames, truth)
    return out


def figures_of(frames: Sequence[Frame], truth: Truth) -> dict[str, float]:
    """Errors of the poses as published live, their NEES, and the share of LOST."""
    stamps = np.array([f.stamp for f in frames], dtype=np.int64)
    live = Trajectory(stamps, np.array([f.T_map_base for f in frames]))
    e = trajectory_errors(live, truth.trajectory, False)
    normalised = nees(e, np.array([f.cov_map for f in frames]))
    return {
        'ate_m': float(np.sqrt((e.distances**2).mean())),
        'max_m': float(e.distances.max()),
        'along_m': float(np.abs(e.errors[:, 0]).max()),
        'heading_deg': float(np.degrees(np.sqrt((e.errors[:, 2] ** 2).mean()))),
        'nees': float(np.nanmean(normalised)),
        'coverage': float(np.mean(normalised[np.isfinite(normalised)] <= INSIDE)),
        'lost': float(np.mean([f.health.level == Level.LOST for f in frames])),
    }


def evaluate_kidnap(seed: int, values: Mapping[str, Any]) -> dict[str, Any]:
    """A robot that is carried to where it has been: seconds until it knows, and errors."""
    rng = np.random.default_rng(seed)
    at = float(rng.uniform(*KIDNAPPED))
    back = float(rng.uniform(3.0, at - 25.0))
    p: SimulatorParameters = from_mapping(
        {'world': 'hall', 'kidnap_time': at, 'kidnap_distance': -back}, SimulatorParameters
    )
    messages, truth = simulate(p, seed)
    frames = [f for some in feed(system(p, values), messages) for f in some]
    t = np.array([(f.stamp - START) / SECOND - at for f in frames])
    levels = np.array([f.health.level for f in frames])
    lost = t[(levels == Level.LOST) & (t >= 0.0)]
    found = t[(levels == Level.OK) & (t > lost[0])] if len(lost) else lost
    after = [f for f, s in zip(frames, t, strict=True) if len(found) and s >= found[0]]
    return {
        'seed': seed,
        'distance_m': back,
        'lost_s': round(float(lost[0]), 2) if len(lost) else None,
        'found_s': round(float(found[0]), 2) if len(found) else None,
        'false_alarms': int(np.sum((levels == Level.LOST) & (t < 0.0))),
        'max_m': figures_of(after, truth)['max_m'] if after else None,
    }


def summarize(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Mean and extreme of each figure over the seeds."""
    out: dict[str, Any] = {'seeds': len(rows)}
    for key in COLUMNS:
        v = np.array([r[key] for r in rows])
        out[key] = {'mean': float(v.mean()), 'max': float(v.max()), 'per_seed': v.tolist()}
    return out


def robustness(drives: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """ATE with each fault over that of the clean drives: of the means, and the worst seed's."""
    out = {}
    for name, s in drives.items():
        world, fault = name.split(', ')
        clean = drives.get(f'{world}, both')
        if fault not in FAULTS or clean is None:
            continue
        a, b = np.array(s['ate_m']['per_seed']), np.array(clean['ate_m']['per_seed'])
        out[name] = {
            'ratio': float(a.mean() / b.mean()),
            'worst': float((a / b).max()),
            'max_m': s['max_m']['max'],
        }
    return out


def text(summary: Mapping[str, Any]) -> str:
    """The tables as text."""
    drives = [['world, system or fault', *(c[0] for c in COLUMNS.values())], *drive_rows(summary)]
    faults = [FAULT_HEADER, *fault_rows(summary)]
    return '\n\n'.join([aligned(drives), aligned(faults), kidnap_text(summary)])
