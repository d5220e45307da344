# SPDX-License-Identifier: Apache-2.0
"""``study tf-only``: bags of scans, /tf and /tf_static alone, against the same drives with topics.

Both have the same scans and the same odometry, and no IMU. Reflectors are those of the intensities
against those of the simulated detector, whose noise is another one: so a single pair of drives
says little, and the mean of the logarithms of the ratios is what is tested. The frame of a map
is the first pose: the few scans until the robot drives decide how far all of it is off. "Fitted"
errors are those of path and reflectors after the path was laid onto the true one. A reflector that
one of both drives alone has found, such as one at grazing incidence, is not "of both".
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.support.parallel_jobs import add_workers, each, workers_of
from rlml_slam import se2
from rlml_slam.cli.simulate import write_bag
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import MATCH_RADIUS, metrics, reflector_figures
from rlml_slam.evaluation.run_record import Run
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world

WORLDS = ('hall', 'corridor', 'symmetric', 'yard', 'room')
ERRORS = {
    'live_ate_rmse_m': 'live', 'ate_rmse_m': 'optimised', 'reflector_rmse_m': 'reflectors',
    'shape_m': 'optimised, fitted', 'reflector_shape_m': 'reflectors, fitted',
    'both_m': 'reflectors of both', 'both_shape_m': 'reflectors of both, fitted',
}  # fmt: skip
LIMIT = 1.05  # of the errors with topics


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study tf-only``."""
    parser = subparsers.add_parser('tf-only', help='bags as robots record, against topics')
    parser.add_argument('--world', nargs='+', default=list(WORLDS), metavar='NAME')
    parser.add_argument('--seeds', type=int, default=3, help='(default: %(default)s)')
    parser.add_argument('--duration', type=float, default=0.0, help='of a drive [s]; 0: whole')
    add_workers(parser)


def run(args: argparse.Namespace) -> int:
    """A row per drive, and the mean ratio of each error; 1 where one is beyond the limit."""
    tasks = [(w, seed, args.duration) for w in args.world for seed in range(args.seeds)]
    found: list[dict[str, tuple[float, float]]] = []
    for (world, seed, _), pair in each(compare, tasks, workers_of(args)):
        found.append(pair)
        shown = ', '.join(
            f'{ERRORS[e]} {1e3 * b:.1f} / {1e3 * a:.1f} mm' for e, (a, b) in pair.items()
            if e in ERRORS
        )  # fmt: skip
        counts = ' / '.join(f'{n:.0f}' for n in pair['reflectors_found'][::-1])
        print(f'{world}, seed {seed}: {shown}, reflectors {counts}', flush=True)
    print('\nalone / with topics, over drives:')
    worst = 0.0
    for error, title in ERRORS.items():
        logs = np.log([p[error][1] / p[error][0] for p in found])
        spread = float(np.std(logs, ddof=1)) if len(logs) > 1 else np.nan
        mean, of_mean = float(np.exp(logs.mean())), spread / np.sqrt(len(logs))
        worst = max(worst, mean)
        ratios = np.exp(logs)
        print(
            f'{title}: mean {mean:.3f} ± {of_mean:.3f}, spread {spread:.3f}, largest '
            f'{ratios.max():.3f}; {np.sum(ratios > LIMIT)} of {len(ratios)} beyond {LIMIT}'
        )
    return int(worst > LIMIT)


def compare(world: str, seed: int, duration: float) -> dict[str, tuple[float, float]]:
    """Figures with topics, and of the transforms and intensities alone."""
    values = {'world': world, 'seed': seed, 'duration': duration}
    p: SimulatorParameters = from_mapping(values, SimulatorParameters)
    params = Parameters()
    without_imu = replace(params, node=replace(params.node, use_imu=False))
    with tempfile.TemporaryDirectory() as folder:
        both, distances = [], []
        for name, given in (('topics', without_imu), ('tf', params)):
            bag = Path(folder) / name
            write_bag(Simulation(load_world(world), p), bag, tf_only=name == 'tf')
            run = replay(bag, given)
            assert run.truth is not None
            fit = trajectory_errors(run.trajectory, run.truth.trajectory, aligned=True)
            fitted = reflector_figures(run, fit.T_truth_map)
            shape = {
                'shape_m': fit.summary()['rmse_m'],
                'reflector_shape_m': fitted['reflector_rmse_m'],
            }
            both.append(metrics(run) | shape)
            frames = (np.zeros(3), fit.T_truth_map)
            distances.append([distances_of(run, T) for T in frames])
    is_of_both = np.isfinite(distances).all(axis=(0, 1))
    for k, of_frames in enumerate(distances):
        for error, d in zip(('both_m', 'both_shape_m'), of_frames, strict=True):
            both[k][error] = float(np.sqrt(np.mean(d[is_of_both] ** 2)))
    names = (*ERRORS, 'reflectors_found', 'reflectors_spurious')
    return {name: (both[0][name], both[1][name]) for name in names}


def distances_of(run: Run, T_truth_map: Array) -> Array:
    """Distance [m] of each true reflector from the nearest of the map, NaN of one not found."""
    assert run.truth is not None
    points = se2.transform(T_truth_map, run.reflectors.points)
    d = np.linalg.norm(points - run.truth.reflectors[:, None], axis=-1).min(axis=1)
    return np.where(d <= MATCH_RADIUS, d, np.nan)
