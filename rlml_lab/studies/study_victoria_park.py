# SPDX-License-Identifier: Apache-2.0
"""``study victoria-park``: dead reckoning, EKF and RLML on the ute among trees, against GPS.

The trees are anonymous. GPS positions and an estimate are in frames of their own, so each
estimate is aligned to the GPS before it is compared.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.datasets.victoria_park import (
    LASER_FRAME,
    T_BASE_LASER,
    VictoriaPark,
    read_victoria_park,
)
from rlml_slam import se2, warm_up
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.params import EkfParameters, from_mapping, read_yaml
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Detections, Odometry, Reflectors

SYSTEMS = ('dead_reckoning', 'ekf', 'rlml')


@dataclass(frozen=True)
class Result:
    """Trajectory and trees of one system, its time in all and per scan [ms]."""

    trajectory: Trajectory
    trees: Reflectors | None = None
    wall_s: float = 0.0
    wall_ms: Array | None = None


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study victoria-park``."""
    parser = subparsers.add_parser(
        'victoria-park', help='dead reckoning, EKF and RLML among trees, against GPS'
    )
    parser.add_argument('folder', metavar='DIR', type=Path, help='folder of the .mat files')
    parser.add_argument('--system', nargs='+', default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument('--duration', type=float, default=0.0, metavar='S', help='0 is all of it')
    parser.add_argument('--config', type=Path, metavar='YAML', help='parameters that differ')
    parser.add_argument('--out', type=Path, metavar='PNG', help='picture to be written')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run the systems, print the figures, draw the picture."""
    data = read_victoria_park(args.folder)
    params: EkfParameters = from_mapping(
        read_yaml(args.config, EkfParameters) if args.config else {}, EkfParameters
    )
    results = {s: drive(data, s, params, args.duration, args.json) for s in args.system}
    figures = {s: evaluate(r, data.gps) for s, r in results.items()}
    if args.out is not None:
        write_atomically(args.out, picture(results, figures, data.gps))
    if args.json:
        print(json.dumps(figures))
    else:
        print('\n'.join(f'{s:<16}' + describe(f) for s, f in figures.items()))
    return 0


def drive(
    data: VictoriaPark,
    system: str,
    params: EkfParameters,
    duration: float = 0.0,
    quiet: bool = True,
) -> Result:
    """One system over the drive, or the first ``duration`` seconds of it."""
    start = data.odometry[0].stamp
    end = start + int(duration * 1e9) if duration > 0.0 else data.odometry[-1].stamp
    odometry = [o for o in data.odometry if o.stamp <= end]
    if system == 'dead_reckoning':
        stamps = np.array([o.stamp for o in odometry], dtype=np.int64)
        return Result(Trajectory(stamps, np.array([o.pose for o in odometry])))
    slam: Slam | EkfSlam = Slam(params) if system == 'rlml' else EkfSlam(params)
    slam.set_sensor_pose(LASER_FRAME, T_BASE_LASER)
    warm_up.compile_loaded()
    inputs: list[Odometry | Detections] = [
        *odometry,
        *(d for d in data.detections if d.stamp <= end),
    ]
    log, began = FrameLog(), time.perf_counter()
    with Progress(system, (end - start) * 1e-9, quiet) as progress:
        for k, item in enumerate(sorted(inputs, key=lambda i: i.stamp)):
            if isinstance(item, Odometry):
                log.add(slam.add_odometry(item))
            else:
                log.add(slam.add_detections(item))
            if k % 500 == 0:
                progress.update((item.stamp - start) * 1e-9)
    log.add(slam.finish())
    wall = time.perf_counter() - began
    return Result(Trajectory(*slam.trajectory()), slam.reflectors(), wall, np.array(log.wall_ms))


def evaluate(result: Result, gps: Trajectory) -> dict[str, Any]:
    """Position errors [m] where GPS is known, trees, and time."""
    errors = trajectory_errors(result.trajectory, gps, aligned=True).summary()
    out: dict[str, Any] = {k: round(errors[k], 3) for k in ('rmse_m', 'median_m', 'max_m')}
    out['compared'] = errors['matched']
    if result.trees is not None and result.wall_ms is not None:
        out['trees'] = len(result.trees)
        out['wall_s'] = round(result.wall_s, 1)
        out['ms_median'] = round(float(np.median(result.wall_ms)), 2)
        out['ms_p99'] = round(float(np.percentile(result.wall_ms, 99)), 2)
    return out


def describe(figures: dict[str, Any]) -> str:
    """The figures of one system in a line."""
    return ', '.join(f'{name} {value}' for name, value in figures.items())


def picture(results: dict[str, Result], figures: dict[str, Any], gps: Trajectory) -> bytes:
    """Each system's path and trees over the GPS positions."""
    # matplotlib takes half a second to import, which other commands need not wait for
    from matplotlib.figure import Figure

    from rlml_slam.report.pictures import PATH, REFLECTOR, TRUTH, png

    figure = Figure(figsize=(6.5 * len(results), 6.5), layout='constrained')
    panels = figure.subplots(1, len(results), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (system, result) in zip(panels, results.items(), strict=True):
        T = trajectory_errors(result.trajectory, gps, aligned=True).T_truth_map
        axes.plot(*gps.poses[:, :2].T, '.', color=TRUTH, ms=1.5, label='GPS')
        axes.plot(*se2.transform(T, result.trajectory.poses[:, :2]).T, color=PATH, lw=0.8)
        if result.trees is not None and len(result.trees):
            trees = se2.transform(T, result.trees.points)
            axes.plot(*trees.T, '+', color=REFLECTOR, ms=4, label=f'{len(trees)} trees')
        axes.set(
            aspect='equal', xlabel='x [m]',
            title=f'{system.replace("_", " ")}: {figures[system]["rmse_m"]:.1f} m',
        )  # fmt: skip
        axes.legend(fontsize=8, loc='upper right')
    # a path that is lost must not make the park a dot
    low, high = gps.poses[:, :2].min(axis=0) - 40.0, gps.poses[:, :2].max(axis=0) + 40.0
    panels[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), ylabel='y [m]')
    return png(figure)
