# SPDX-License-Identifier: Apache-2.0
"""Graph sparsification: keyframes per place, edges and sightings are bounded.

Where a place has enough keyframes, a new one is marginalized (graph/reduction/marginalization.py).
Its sightings are moved to the neighbour with the tightest edge, and its scan replaces the oldest
one at the place, so that the map follows changes. Of the edges between the remaining keyframes and
of the sightings that one has taken over, the least informative ones are removed
(graph/reduction/edge_pruning.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph import (
    FactorKind,
    OnlineSolver,
    RelativePoses,
    Renumbering,
    marginalize_pose,
    prune_edges,
)
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.scan_graph import ScanGraph
from rlml_slam.slam.back_end.trajectory import FrameTrajectory
from rlml_slam.slam.closures.loop_closer import LoopCloser
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph

# Edges per keyframe, as many as a new one adds: odometry, two submaps, and a closure. Their mean
# leverage is a quarter.
EDGES = 4
BATCH = 20  # edges removed together: ranking them takes as long as a solve
RECENT = 10  # newest keyframes that stay in any case: the next ones may be matched with them


class Sparsifier:
    """Checks every keyframe once, when no active submap needs it any more."""

    def __init__(
        self,
        params: Parameters,
        solver: OnlineSolver,
        scan_graph: ScanGraph,
        loop_closer: LoopCloser,
        reflectors: ReflectorGraph,
    ) -> None:
        self._p = params.back_end
        self._solver = solver
        self._graph = solver.graph
        self._scan_graph = scan_graph
        self._loop_closer = loop_closer
        self._reflectors = reflectors
        self._num_checked = 0
        self._receivers: list[Keyframe] = []  # keyframes that took over sightings, the last time

    def sparsify(self, keys: list[Keyframe], trajectory: FrameTrajectory) -> bool:
        """Remove redundant keyframes and renumber the others; whether there were any."""
        if not self._p.keyframes_per_place:
            return False
        end = self._end(len(keys))
        poses = self._graph.poses
        covers = self._redundant(poses, [k.scan_stamp for k in keys], end)
        if not covers:
            return False
        edges, ties = self._eliminate(list(covers))
        self._num_checked += len(covers) - len(ties)
        covers = {pose: onto for pose, onto in covers.items() if pose in ties}
        if not covers:
            return False
        for pose, onto in covers.items():
            keys[onto].take_scan(keys[pose], se2.between(poses[onto], poses[pose]))
            self._scan_graph.move_anchors(pose, keys[onto])
        before = poses.copy()
        self._reflectors.move(ties)
        receivers = [keys[k] for k in sorted({onto for onto, _ in ties.values()})]
        receivers = [*self._receivers, *receivers]
        kept = np.ones(len(keys), dtype=np.bool_)
        kept[list(covers)] = False
        new = self._keep(kept, edges, {k: onto for k, (onto, _) in ties.items()})
        onto_of = np.full(len(keys), -1)
        onto_of[list(covers)] = list(covers.values())
        trajectory.renumber(before, new.poses, onto_of)
        keys[:] = remaining(keys, kept)
        left = set(keys)
        self._receivers = [key for key in dict.fromkeys(receivers) if key in left]
        return True

    def thin(self) -> None:
        """Remove sightings of keyframes that took over more than a new keyframe has.

        The graph has to be solved: the solver's factorization gives the information of each.
        """
        for key in self._receivers:
            self._reflectors.thin(key.index)
        self._receivers = []

    def prune(self, num: int) -> None:
        """Remove edges between the ``num`` keyframes where there are too many."""
        e = self._graph.edges
        poses = len(np.unique(e.nodes[e.enabled]))
        if not self._p.keyframes_per_place or e.enabled.sum() <= EDGES * poses + BATCH:
            return
        # odometry keeps the graph connected, and the newest edges are not final yet
        may = (e.kinds != FactorKind.ODOMETRY) & (e.nodes < self._end(num)).all(-1)
        may[self._loop_closer.unsolved_edges()] = False
        removed = prune_edges(self._graph, may, EDGES * poses)
        if len(removed):
            kept = np.ones(num, dtype=np.bool_)
            self._keep(kept, dict.fromkeys(removed.tolist(), -1), {})

    def _end(self, num: int) -> int:
        """Index of the first of the ``num`` keyframes that has to stay."""
        needed = self._scan_graph.oldest_active
        return num - RECENT if needed is None else min(num - RECENT, needed)

    def _keep(
        self, kept: NDArray[np.bool_], edges: dict[int, int], poses: dict[int, int]
    ) -> Renumbering:
        """Remove all poses but ``kept`` (n,); ``edges`` and ``poses`` map to replacements."""
        recorded = np.zeros(len(self._graph.edges), dtype=np.bool_)
        of = [edges.get(k, k) for k in self._loop_closer.records.edges.tolist()]
        recorded[[k for k in of if k >= 0]] = True
        new = self._solver.keep(kept, self._reflectors.used_landmarks(), recorded)
        self._reflectors.renumber(new)
        self._loop_closer.renumber(new, edges, poses, self._scan_graph.finished)
        return new

    def _eliminate(
        self, poses: list[int]
    ) -> tuple[dict[int, int], dict[int, tuple[int, RelativePoses]]]:
        """Marginalize poses: replacement of each of their edges (-1 for none) and of each pose.

        A pose whose neighbours cannot be connected stays.
        """
        edges: dict[int, int] = {}
        ties: dict[int, tuple[int, RelativePoses]] = {}
        floor2 = np.array(self._p.scan_edge_variance_floor)
        e = self._graph.edges
        left = np.array(poses)
        while len(left):  # poses with few neighbours first: minimum degree order
            degrees = np.bincount(e.nodes[e.enabled].ravel(), minlength=int(left.max()) + 1)[left]
            pose = int(left[np.argmin(degrees)])
            left = left[left != pose]
            try:
                done = marginalize_pose(self._graph, pose, floor2)
            except SolverError:
                continue
            ties[pose] = done.hub, done.from_hub
            edges.update(done.edges)
        for pose in reversed(ties):  # the replacement may have been marginalized later
            onto, tie = ties[pose]
            if onto in ties:
                last, back = ties[onto]
                ties[pose] = last, back.compose(tie)
        for first, last in reversed(edges.items()):
            edges[first] = edges.get(last, last)
        return edges, ties

    def _redundant(self, poses: Array, scan_stamps: list[int], end: int) -> dict[int, int]:
        """Redundant keyframes before ``end``, each with the one whose scan it replaces."""
        p, fixed = self._p, self._graph.fixed_poses
        out: dict[int, int] = {}
        if end <= self._num_checked:
            return out
        unsolved = self._graph.edges.nodes[self._loop_closer.unsolved_edges()]
        not_solved = set(unsolved.ravel().tolist())
        near = cKDTree(poses[:end, :2]).query_ball_point(
            poses[self._num_checked : end, :2], p.place_distance
        )
        for k, others in enumerate(near, self._num_checked):
            if len(out) > p.optimize_every:  # more than are added meanwhile
                break
            if k in not_solved:  # marginalization needs the estimate with its closures
                break
            turns = np.abs(se2.wrap(poses[others, 2] - poses[k, 2]))
            same = [
                i for i, turn in zip(others, turns, strict=True)
                if i < k and i not in out and turn < p.place_heading
            ]  # fmt: skip
            if len(same) >= p.keyframes_per_place and not fixed[k]:
                out[k] = min(same, key=scan_stamps.__getitem__)
                scan_stamps[out[k]] = scan_stamps[k]
            self._num_checked += k not in out  # by the index that it will have
        return out


def remaining(keys: list[Keyframe], kept: NDArray[np.bool_]) -> list[Keyframe]:
    """Keyframes that are ``kept`` (n,), with their new indices.

    A jump at a removed keyframe is passed on to the next one.
    """
    out: list[Keyframe] = []
    jumped = False
    for key, stays in zip(keys, kept.tolist(), strict=True):
        jumped |= key.jumped
        if stays:
            key.index, key.jumped, jumped = len(out), jumped, False
            out.append(key)
    return out
