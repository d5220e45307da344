# SPDX-License-Identifier: Apache-2.0
"""``study repeatability``: how often spikes and RANSAC lines of a real log are seen again.

A log whose poses were corrected by someone else gives where each extracted landmark lies. Places
nearer than a radius are one landmark; a good extractor finds few landmarks many times.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.carmen import CarmenLog, read_carmen
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.estimation.landmark_models import POINT, line_model
from rlml_slam.evaluation.ate import interpolate
from rlml_slam.params import EkfParameters, from_mapping, read_yaml
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import project
from rlml_slam.sensing.features import lines, spikes
from rlml_slam.types import Scan

# logs of this kind have a beam per degree; the default consensus is for four per degree
PARAMETERS: dict[str, Any] = {'ransac.consensus': 15}
TIMES = (2, 3, 5, 10, 20, 50)


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study repeatability``."""
    parser = subparsers.add_parser(
        'repeatability', help='how often spikes and lines of a corrected log are seen again'
    )
    parser.add_argument('log', metavar='LOG', type=Path, help='CARMEN log with corrected poses')
    parser.add_argument('--every', type=int, default=1, metavar='N', help='use every N-th scan')
    parser.add_argument(
        '--radius', type=float, default=0.3, metavar='M', help='nearer places are one landmark'
    )
    parser.add_argument('--config', type=Path, metavar='YAML', help='parameters that differ')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Print a row for each extractor."""
    values = read_yaml(args.config, EkfParameters) if args.config else {}
    params: EkfParameters = from_mapping({**PARAMETERS, **values}, EkfParameters)
    log = read_carmen(args.log)
    path = Trajectory(
        np.array([o.stamp for o in log.odometry], dtype=np.int64),
        np.array([o.pose for o in log.odometry]),
    )
    figures = {
        name: repeatability(places, args.radius)
        for name, places in extract(log, path, params, args.every, args.json).items()
    }
    print(json.dumps(figures) if args.json else text(figures))
    return 0


def extract(
    log: CarmenLog, path: Trajectory, params: EkfParameters, every: int, quiet: bool = True
) -> dict[str, list[Array]]:
    """Places (k, 2) of the spikes and lines of each scan.

    A line is its point nearest to the middle of the path.
    """
    scans = log.scans[::every]
    poses, known = interpolate(path, np.array([s.stamp for s in scans], dtype=np.int64))
    model = line_model(path.poses[:, :2].mean(axis=0))
    out: dict[str, list[Array]] = {'spikes': [], 'lines': []}
    with Progress('scans', len(scans), quiet) as progress:
        for k in np.flatnonzero(known):
            T_map_laser = se2.compose(poses[k], log.T_base_laser)
            points = spikes.extract(scans[k], params.spikes).points
            out['spikes'].append(POINT.place(T_map_laser, polar(points))[0])
            found = lines.extract(end_points(scans[k], params), np.zeros(2), params.ransac)
            out['lines'].append(model.place(T_map_laser, found.lines)[0])
            progress.update(float(k))
    return out


def end_points(scan: Scan, params: EkfParameters) -> Array:
    """End points (n, 2) of the valid beams in the frame of the laser."""
    return project(scan, np.zeros(3), np.zeros((1, 3)), params.submap.max_laser_range)


def polar(points: Array) -> Array:
    """Range and bearing (k, 2) of points."""
    return np.stack([np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])],
                    -1)  # fmt: skip


def count_sightings(scans: list[Array], radius: float) -> NDArray[np.int64]:
    """In how many scans each landmark (m,) was seen, by nearest mean place within the radius."""
    sums, counts = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    for places in scans:
        if not len(places):
            continue
        means = sums / np.maximum(counts, 1)[:, None]
        gap = np.linalg.norm(places[:, None] - means[None], axis=-1)
        near = gap.min(axis=1, initial=np.inf) <= radius
        # one scan sees a landmark once
        seen, first = np.unique(gap[near].argmin(axis=1), return_index=True) if near.any() else (
            np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))  # fmt: skip
        sums[seen] += places[near][first]
        counts[seen] += 1
        sums = np.concatenate([sums, places[~near]])
        counts = np.concatenate([counts, np.ones(int(np.sum(~near)), dtype=np.int64)])
    return counts


def repeatability(scans: list[Array], radius: float) -> dict[str, Any]:
    """Share of the landmarks seen at least N times, and of the detections that are of those."""
    counts = count_sightings(scans, radius)
    total = max(int(counts.sum()), 1)
    return {
        'scans': len(scans),
        'per_scan': round(float(np.mean([len(p) for p in scans])), 2) if scans else 0.0,
        'landmarks': len(counts),
        'share_of_landmarks': {
            n: round(float(np.mean(counts >= n)), 4) if len(counts) else 0.0 for n in TIMES
        },
        'share_of_detections': {
            n: round(float(counts[counts >= n].sum() / total), 4) for n in TIMES
        },
    }


def text(figures: dict[str, Any]) -> str:
    """A row for each extractor."""
    rows = []
    for name, f in figures.items():
        rows.append(
            f'{name}: {f["per_scan"]} per scan in {f["scans"]} scans, {f["landmarks"]} landmarks'
        )
        for what in ('landmarks', 'detections'):
            shares = '  '.join(f'>= {n}: {s:.1%}' for n, s in f[f'share_of_{what}'].items())
            rows.append(f'  share of {what} seen {shares}')
    return '\n'.join(rows)
