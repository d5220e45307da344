# SPDX-License-Identifier: Apache-2.0
"""The poses of a localization that a bag has, on a topic of its own or on /tf."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import BagError, InputError
from rlml_slam.params import Node
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.ros.tf_odometry import TfOdometry
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.odometry_sources import PoseHistory
from rlml_slam.types import Odometry

TF = '/tf'
WHOLE = 1e6  # [s] of transforms that are remembered


def poses_of(bag: BagReader, topic: str) -> Trajectory:
    """The poses of a topic; what cannot be believed is left out. Raises BagError."""
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
    """Map to base at the stamps of a path, as a buffer of tf2 has it. Raises BagError."""
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
