# SPDX-License-Identifier: Apache-2.0
"""``rlml compare``: from a bag of both, how far two localizations were apart."""

from __future__ import annotations

import argparse
import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import BagError, InputError
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.params import Node
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.ros.tf_odometry import TfOdometry
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.odometry_sources import PoseHistory
from rlml_slam.types import Odometry

TF = '/tf'
OURS = ('/shadow/pose', '/pose')
WHOLE = 1e6  # [s] of transforms that are remembered
MAX_GAP = 500_000_000  # [ns] over which poses of the other are not interpolated


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml compare``."""
    parser = subparsers.add_parser(
        'compare',
        help='from a bag of both, how far two localizations were apart',
        description='Compares the poses of a node in shadow mode with map to base on /tf, or with '
        'a topic of poses. The maps may differ: one path is first fitted to the other.',
    )
    parser.add_argument('bag', metavar='BAG', type=Path)
    parser.add_argument(
        '--ours', metavar='TOPIC', default='', help=f'default: {OURS[0]}, else {OURS[1]}'
    )
    parser.add_argument(
        '--other', metavar='TOPIC', default=TF, help='/tf, or poses (default: %(default)s)'
    )
    parser.add_argument('--map-frame', default='map', metavar='FRAME')
    parser.add_argument('--base-frame', default='base_link', metavar='FRAME')
    parser.add_argument('--same-map', action='store_true', help='do not fit: both have one map')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Compare and print."""
    with BagReader(args.bag) as bag:
        ours = args.ours or next((t for t in OURS if t in bag.topics), OURS[0])
        path = poses_of(bag, ours)
        if args.other == TF:
            other = poses_on_tf(bag, path, args.map_frame, args.base_frame)
        else:
            other = poses_of(bag, args.other)
    errors = trajectory_errors(path, other, not args.same_map, MAX_GAP)
    figures = {'ours': ours, 'other': args.other, **errors.summary()}
    print(json.dumps(figures) if args.json else text_of(figures, args.same_map))
    return 0


def text_of(f: dict[str, Any], same_map: bool) -> str:
    """The figures for people."""
    fitted = '' if same_map else ', after one path was fitted to the other'
    lines = [
        f'{f["ours"]} against {f["other"]}: {f["matched"]:.0f} poses compared, '
        f'{f["unmatched"]:.0f} without the other{fitted}',
        f'position  median {f["median_m"]:.3f} m, rms {f["rmse_m"]:.3f} m, max {f["max_m"]:.3f} m',
    ]
    if 'heading_rmse_deg' in f:
        lines.append(f'heading   rms {f["heading_rmse_deg"]:.3f} degrees')
    return '\n'.join(lines)


def poses_of(bag: BagReader, topic: str) -> Trajectory:
    """The poses of a topic; what cannot be believed is left out."""
    if topic not in bag.topics:
        raise BagError(f'{bag.path}: no topic {topic}; it has {", ".join(sorted(bag.topics))}')
    found: dict[int, Array] = {}
    for _, _, msg in bag.messages([topic]):
        with contextlib.suppress(InputError, AttributeError):
            pose = getattr(msg.pose, 'pose', msg.pose)
            found[decode.stamp(msg, topic)] = decode.planar_pose(pose, topic)
    if not found:
        raise BagError(f'{bag.path}: {topic} has no pose')
    return Trajectory(
        np.array(sorted(found), np.int64), np.array([found[t] for t in sorted(found)])
    )


def poses_on_tf(bag: BagReader, path: Trajectory, map_frame: str, base_frame: str) -> Trajectory:
    """Map to base at the stamps of a path, as a buffer of tf2 has it."""
    n, tree = Node(), Extrinsics()
    odom = TfOdometry(tree, n.odom_frame, base_frame, map_frame)
    steps = (PoseHistory(WHOLE), PoseHistory(WHOLE))
    for topic in ('/tf_static', TF):
        for _, _, msg in bag.messages([topic]) if topic in bag.topics else ():
            for t in msg.transforms:
                with contextlib.suppress(InputError):
                    if topic != TF:
                        tree.add(decode.transforms(t))
                    elif decode.frame(t.child_frame_id) == n.odom_frame:
                        steps[0].add(_sample(t))
                    else:
                        for sample in odom.add(t):
                            steps[1].add(sample)
    found = [(s, *(h.at(int(s)) for h in steps)) for s in path.stamps]
    known = [(s, se2.compose(a, b)) for s, a, b in found if a is not None and b is not None]
    if not known:
        raise BagError(
            f'{bag.path}: {TF} has no {map_frame} to {n.odom_frame} to {base_frame} at the poses'
        )
    return Trajectory(np.array([s for s, _ in known], np.int64), np.array([T for _, T in known]))


def _sample(transform: Any) -> Odometry:
    (t,) = decode.transforms(transform, TF)
    return Odometry(decode.stamp(transform, TF), np.array([*t.t[:2], decode.yaw(t.R, TF)]))
