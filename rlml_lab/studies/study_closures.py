# SPDX-License-Identifier: Apache-2.0
"""``study closures``: whether the loop closures of a real log are right, by its relations.

The relations of the SLAM benchmark (Kümmerle et al. 2009) are solved as a graph of their own; its
poses, carried to the keyframes by the short way along the estimate, say how each closure should
be. ``--scale`` and ``--turn`` spoil the odometry.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rlml_slam import params, se2, warm_up
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.relations import Relations, nearest, read_relations, relation_errors
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.graph import Graph
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.loop_closure import State
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import EdgeKind, Frame, Odometry

SIGMA = np.array([0.03, 0.03, 0.01])  # of a relation: about what the benchmark's authors state
WRONG, WRONG_TURN = 1.0, np.radians(15.0)  # [m], [rad]: another place, not a poor match
AWAY = 2_000_000_000  # [ns] a keyframe farther from any relation is not checked
REACH = 5.0  # [m] from a submap's anchor, in which a closure should be found


class MisledSlam(Slam):
    """The system behind odometry: its way ``scale``, its turns ``turn`` times as large."""

    scale, turn = 1.0, 1.0
    _last: Array | None = None
    _told: Array | None = None

    def add_odometry(self, sample: Odometry) -> list[Frame]:
        """One sample, spoilt."""
        if self._last is None or self._told is None:
            self._told = sample.pose
        else:
            step = se2.log(se2.between(self._last, sample.pose))
            step = step * np.array([self.scale, self.scale, self.turn])
            self._told = se2.compose(self._told, se2.exp(step))
        self._last = sample.pose
        return super().add_odometry(replace(sample, pose=self._told))


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study closures``."""
    parser = subparsers.add_parser(
        'closures', help='whether the loop closures of a log are right, by its relations'
    )
    parser.add_argument('bag', metavar='BAG', type=Path, help='rosbag2 folder or ROS 1 .bag')
    parser.add_argument('relations', metavar='RELATIONS', type=Path, help='of the SLAM benchmark')
    parser.add_argument('--scale', type=float, default=1.0, help='of the odometry (default 1)')
    parser.add_argument('--turn', type=float, default=1.0, help='of its turns (default 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Drive the system, check its closures, print."""
    relations = read_relations(args.relations)
    slam = drive(args.bag, args.scale, args.turn, args.json)
    stamps, poses = slam.trajectory()
    figures = evaluate(slam, relations)
    errors = relation_errors(Trajectory(stamps, poses), relations).summary()
    figures |= {k: errors[k] for k in ('trans_mean_m', 'trans_max_m', 'rot_mean_deg')}
    if args.json:
        print(json.dumps(figures))
    else:
        print('\n'.join(f'{name:24} {value:g}' for name, value in figures.items()))
    return 0


def drive(bag_path: Path, scale: float, turn: float, quiet: bool) -> Slam:
    """The system after a bag; keyframes are all kept, so that each closure is as it was made."""
    warm_up.compile_loaded()
    parameters = params.Parameters(back_end=params.BackEnd(keyframes_per_place=0))
    slam = MisledSlam(parameters)
    slam.scale, slam.turn = scale, turn
    with BagReader(bag_path) as bag, Progress('replay', 1.0, quiet) as progress:
        inputs = BagInputs(bag, parameters)
        feed = SensorInput(parameters, slam, slam.synchronizer.inputs)
        feed.use_extrinsics(inputs.extrinsics)
        for k, (time, stream, message) in enumerate(inputs):
            feed.add(stream, message)
            if k % 1000 == 0:
                progress.update((time - bag.start) / max(bag.end - bag.start, 1), '')
        slam.finish()
    return slam


def reference(relations: Relations) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Stamps (n,), poses (n, 3) that the relations agree on, and the connected part of each."""
    stamps, nodes = np.unique(relations.stamps, return_inverse=True)
    nodes, n = nodes.reshape(-1, 2), len(stamps)
    links = sparse.csr_matrix((np.ones(len(nodes)), (nodes[:, 0], nodes[:, 1])), (n, n))
    part = sparse.csgraph.connected_components(links, directed=False)[1]
    graph = Graph()
    graph.add_poses(np.zeros((n, 3)))
    graph.fixed_poses[np.unique(part, return_index=True)[1]] = True
    information = np.broadcast_to(np.diag(SIGMA**-2), (len(nodes), 3, 3))
    graph.add_edges(EdgeKind.SCAN, nodes, relations.deltas, information)
    initialize(graph, 'spanning_tree')
    optimize(graph)
    return stamps, graph.poses.copy(), part.astype(np.int64)


def evaluate(slam: Slam, relations: Relations) -> dict[str, float]:
    """How many closures were right, wrong, disabled, and how many of those within reach found."""
    known, poses, part = reference(relations)
    stamps, path = slam.trajectory()
    back_end = slam.back_end
    keys = np.array([key.stamp for key in back_end.keyframes], dtype=np.int64)
    at = nearest(known, keys)
    # from the pose that the relations know to the keyframe, as the estimate has it
    step = se2.between(path[nearest(stamps, known[at])], path[nearest(stamps, keys)])
    true, is_known = se2.compose(poses[at], step), np.abs(known[at] - keys) <= AWAY
    tried = [c for c in back_end.loop_closer.records
             if is_known[c.i] and is_known[c.j] and part[at[c.i]] == part[at[c.j]]]  # fmt: skip
    out = dict.fromkeys(
        ('accepted', 'checked', 'right', 'right_disabled', 'wrong', 'wrong_disabled'), 0.0
    )
    out['accepted'] = float(sum(c.accepted for c in back_end.loop_closer.records))
    reachable = found = 0
    for c in tried:
        T = se2.between(true[c.i], true[c.j])
        reachable += bool(np.hypot(T[0], T[1]) < REACH)
        if not c.accepted:
            continue
        e = se2.between(back_end.graph.edges.measured[c.edge], T)
        verdict = 'wrong' if np.hypot(e[0], e[1]) > WRONG or abs(e[2]) > WRONG_TURN else 'right'
        out['checked'] += 1.0
        out[verdict] += 1.0
        out[f'{verdict}_disabled'] += c.status.state is not State.ACTIVE
        found += verdict == 'right' and bool(np.hypot(T[0], T[1]) < REACH)
    return out | {'within_reach': float(reachable), 'recall': found / max(reachable, 1)}
