# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study drift``: how far the front end's heading drifts, and how far it says."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.faults import recording
from rlml_lab.support.drives import feed
from rlml_slam import se2
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.params import Parameters, from_mapping, read_yaml
from rlml_slam.recordings.bag_replay import patient
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Frame

SPANS = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)  # [m]
LEAST = 1e-8  # [rad²] of a growth: reflectors and turns back may make it negative
NEAR = 60_000_000  # [ns] within which a pose of the truth belongs to a frame


@dataclass(frozen=True)
class Drifts:
    """Errors of the turn between frames that are a way apart, and their predicted sigmas [rad]."""

    errors: Array
    sigmas: Array


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study drift``."""
    parser = subparsers.add_parser(
        'drift',
        help='growth of the heading error by distance, against its sigma',
        description='Compares the turn between poses of the front end with the truth of a '
        'simulated world, or with the optimised trajectory of a recording: as its error grows, '
        'so should its sigma.',
    )
    parser.add_argument('recordings', nargs='+', metavar='BAG', help='bags, or names of worlds')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the system's parameters")


def run(args: argparse.Namespace) -> int:
    """A row for each recording and distance."""
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    lines = [['recording', 'way [m]', 'n', 'rms [mrad]', 'sigma [mrad]', 'median error / sigma']]
    for name in args.recordings:
        given = recording.load(name, None, params)
        slam = Slam(patient(params))
        for frame_id, pose in given.sensors.items():
            slam.set_sensor_pose(frame_id, pose)
        frames = [f for step in feed(slam, given.messages) for f in step]
        true = given.truth or Trajectory(*slam.trajectory())
        for span in SPANS:
            found = drifts(frames, true, span)
            if len(found.errors) > 2:
                lines.append([given.name, f'{span:g}', *row(found)])
    print(aligned(lines))
    return 0


def row(found: Drifts) -> list[str]:
    """Number, rms of errors and of sigmas, and the median ratio, which is .67 where both agree."""
    e, s = found.errors, found.sigmas
    rms, sigma = (1e3 * float(np.sqrt(np.mean(v**2))) for v in (e, s))
    return [str(len(e)), f'{rms:.2f}', f'{sigma:.2f}', f'{np.median(np.abs(e) / s):.2f}']


def drifts(frames: Sequence[Frame], true: Trajectory, span: float) -> Drifts:
    """Of pairs of frames that are ``span`` [m] apart along the way, half of it from each other.

    A pair with a jump of the front end between is left out.
    """
    poses = np.array([f.T_local_base for f in frames])
    variances = np.array([f.cov_local[2, 2] for f in frames])
    jumps = np.cumsum([f.jumped for f in frames])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    stamps: NDArray[np.int64] = np.array([f.stamp for f in frames])
    at = np.clip(np.searchsorted(true.stamps, stamps), 0, len(true.stamps) - 1)
    known = np.abs(true.stamps[at] - stamps) < NEAR
    headings = poses[:, 2] - true.poses[at, 2]
    errors, growth, first = [], [], 0
    while (last := int(np.searchsorted(way, way[first] + span))) < len(way):
        if known[first] and known[last] and jumps[first] == jumps[last]:
            errors.append(se2.wrapped(float(headings[last] - headings[first])))
            growth.append(max(float(variances[last] - variances[first]), LEAST))
        first = max(int(np.searchsorted(way, way[first] + 0.5 * span)), first + 1)
    return Drifts(np.array(errors), np.sqrt(growth))
