# SPDX-License-Identifier: Apache-2.0
"""``rlml study ekf``: RLML, the EKF with each extractor and dead reckoning on the same drives."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2, warm_up
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import ParameterError
from rlml_slam.params import EkfParameters, SimulatorParameters, from_mapping, read_yaml
from rlml_slam.rlml.slam import Slam
from rlml_slam.simulation.simulation import GroundTruth, Message, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.tools.ate import trajectory_errors
from rlml_slam.tools.metrics import metrics
from rlml_slam.tools.progress import Progress
from rlml_slam.tools.record import FrameLog, Truth
from rlml_slam.tools.replay import collect
from rlml_slam.tools.tum import Trajectory
from rlml_slam.types import Imu, Odometry, Scan

SYSTEMS = ('rlml', 'reflectors', 'spikes', 'lines', 'dead_reckoning')
COLUMNS = ('ate_rmse_m', 'heading_rmse_deg', 'nees_mean', 'reflector_rmse_m', 'median_ms')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml study ekf``."""
    parser = subparsers.add_parser(
        'ekf', help='RLML, the EKF with each extractor and dead reckoning on the same drives'
    )
    parser.add_argument('--seeds', type=int, default=3, metavar='N', help='default: %(default)s')
    parser.add_argument('--world', nargs='+', default=['hall', 'room'], metavar='NAME')
    parser.add_argument('--system', nargs='+', default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument('--duration', type=float, default=0.0, metavar='S', help='0 is all of it')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the systems' parameters")
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all systems over all drives and print a row per world and system."""
    if args.seeds < 1:
        raise ParameterError('study ekf: --seeds must be 1 or more')
    values = read_yaml(args.config) if args.config else {}
    rows: dict[str, list[dict[str, Any]]] = {}
    with Progress('study', len(args.world) * args.seeds, args.json) as progress:
        for k, (world, seed) in enumerate((w, s) for w in args.world for s in range(args.seeds)):
            for system, figures in judge_drive(
                world, seed, values, args.system, args.duration
            ).items():
                rows.setdefault(f'{world}, {system}', []).append(figures)
            progress.update(k + 1, f'{world}, seed {seed}')
    summary = {name: summarize(r) for name, r in rows.items()}
    print(json.dumps(summary) if args.json else table(summary))
    return 0


def judge_drive(
    world: str, seed: int, values: Mapping[str, Any], systems: Sequence[str], duration: float
) -> dict[str, dict[str, Any]]:
    """Figures of each system on one simulated drive."""
    p: SimulatorParameters = from_mapping(
        {'world': world, 'duration': duration}, SimulatorParameters
    )
    simulation = Simulation(load_world(world), p, seed)
    messages = [event.message for event in simulation]
    points, ids = simulation.true_reflectors()
    true = [(m.stamp, m.T_map_base) for m in messages if isinstance(m, GroundTruth)]
    path = Trajectory(
        np.array([t for t, _ in true], dtype=np.int64), np.array([x for _, x in true])
    )
    truth = Truth(path, True, ids, points)
    out: dict[str, dict[str, Any]] = {}
    for system in systems:
        if system == 'dead_reckoning':
            out[system] = dead_reckoning(messages, path)
            continue
        params = from_mapping(values, EkfParameters)
        slam: Slam | EkfSlam = Slam(params)
        if system != 'rlml':
            slam = EkfSlam(replace(params, ekf=replace(params.ekf, extractor=system)))
        warm_up.compile_loaded()
        slam.set_sensor_pose(p.node.laser_frame, np.array(p.node.laser_pose))
        log = feed(slam, messages)
        figures = metrics(collect(slam, log, f'{world}, {system}', truth))
        figures['median_ms'] = figures['front_end_ms']['median']
        if system in ('spikes', 'lines'):  # its landmarks are no reflectors
            figures.pop('reflector_rmse_m', None)
        out[system] = figures
    return out


def feed(slam: Slam | EkfSlam, messages: Sequence[Message]) -> FrameLog:
    """All messages in order of arrival; the frames that they gave."""
    log = FrameLog()
    for message in messages:
        if isinstance(message, Odometry):
            log.add(slam.add_odometry(message))
        elif isinstance(message, Imu):
            log.add(slam.add_imu(message))
        elif isinstance(message, Scan):
            log.add(slam.add_scan(message))
        elif not isinstance(message, GroundTruth):
            log.add(slam.add_detections(message))
    log.add(slam.finish())
    return log


def dead_reckoning(messages: Sequence[Message], truth: Trajectory) -> dict[str, Any]:
    """Errors of the odometry alone, which begins at the truth's start."""
    odometry = [m for m in messages if isinstance(m, Odometry)]
    poses = se2.between(odometry[0].pose, np.array([o.pose for o in odometry]))
    stamps = np.array([o.stamp for o in odometry], dtype=np.int64)
    errors = trajectory_errors(Trajectory(stamps, poses), truth).summary()
    return {'ate_rmse_m': errors['rmse_m'], 'heading_rmse_deg': errors['heading_rmse_deg']}


def summarize(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean of each figure over the seeds that have it, None where none has."""
    out: dict[str, Any] = {'seeds': len(rows)}
    for key in COLUMNS:
        known = [float(r[key]) for r in rows if r.get(key) is not None]
        out[key] = float(np.mean(known)) if known else None
    return out


def table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """A row per world and system: means over the seeds."""
    lines = ['  '.join([f'{"world, system":<24}', *(f'{c:>17}' for c in COLUMNS)])]
    for name, s in summary.items():
        cells = [f'{"-" if s[c] is None else format(s[c], ".4f"):>17}' for c in COLUMNS]
        lines.append('  '.join([f'{name:<24}', *cells]))
    return '\n'.join(lines)
