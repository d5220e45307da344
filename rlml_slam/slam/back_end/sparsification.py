# SPDX-License-Identifier: Apache-2.0
"""Bounded growth: where a place has keyframes enough, older ones take over what a new one tells.

What the new one knows of its neighbours goes on between these (graph/eliminate.py), its sightings
are seen from the neighbour it was tied to best, and the place shows its scan instead of the oldest
one, so that the map keeps up with a hall in which things are moved. Of the edges between those
that stay, and of the sightings that one of them has taken over, the least telling ones go where
there are too many (graph/prune.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factor_table import FactorKind
from rlml_slam.graph.model.graph import Renumbering
from rlml_slam.graph.reduction.edge_pruning import prune
from rlml_slam.graph.reduction.marginalization import Ties, eliminate
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.scan_graph import ScanGraph
from rlml_slam.slam.back_end.trajectory import Path
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph

# Edges per keyframe, as many as one comes with: odometry, two submaps, and a closure. Their mean
# leverage is a quarter.
EDGES = 4
SPARE = 20  # more of them are let go together, for judging them takes as long as a solve
RECENT = 10  # keyframes that stay in any case: the next ones may be matched to them


class Sparsifier:
    """Judges every keyframe once, when no submap that is being built needs it any more."""

    def __init__(
        self, params: Parameters, live: OnlineSolver, scans: ScanGraph, reflectors: ReflectorGraph
    ) -> None:
        self._p = params.back_end
        self._live = live
        self._graph = live.graph
        self._scans = scans
        self._reflectors = reflectors
        self._judged = 0
        self._fed: list[Keyframe] = []  # took over sightings, the last time

    def sparsify(self, keys: list[Keyframe], path: Path) -> bool:
        """Let go of redundant keyframes, and number the others anew; whether there were any."""
        if not self._p.keyframes_per_place:
            return False
        end = self._end(len(keys))
        poses = self._graph.poses
        covers = self._redundant(poses, [k.scan_stamp for k in keys], end)
        if not covers:
            return False
        edges, ties = self._eliminate(list(covers))
        self._judged += len(covers) - len(ties)
        covers = {gone: onto for gone, onto in covers.items() if gone in ties}
        if not covers:
            return False
        for gone, onto in covers.items():
            keys[onto].take_scan(keys[gone], se2.between(poses[onto], poses[gone]))
            self._scans.take_over(gone, keys[onto])
        before = poses.copy()
        self._reflectors.move(ties)
        fed = [*self._fed, *(keys[k] for k in sorted({onto for onto, _ in ties.values()}))]
        kept = np.ones(len(keys), dtype=np.bool_)
        kept[list(covers)] = False
        new = self._keep(kept, edges, {k: onto for k, (onto, _) in ties.items()})
        onto_of = np.full(len(keys), -1)
        onto_of[list(covers)] = list(covers.values())
        path.renumber(before, new.poses, onto_of)
        keys[:] = remaining(keys, kept)
        here = set(keys)
        self._fed = [key for key in dict.fromkeys(fed) if key in here]
        return True

    def thin(self) -> None:
        """Let go of sightings of keyframes that have taken over more than one comes with.

        The graph is to be solved: then the solver's tree tells what each of them is worth.
        """
        for key in self._fed:
            self._reflectors.thin(key.index)
        self._fed = []

    def prune(self, num: int) -> None:
        """Let go of edges between the ``num`` keyframes where there are too many."""
        e = self._graph.edges
        poses = len(np.unique(e.nodes[e.enabled]))
        if not self._p.keyframes_per_place or e.enabled.sum() <= EDGES * poses + SPARE:
            return
        # odometry keeps the graph in one piece, and the newest ones are not weighed yet
        may = (e.kinds != FactorKind.ODOMETRY) & (e.nodes < self._end(num)).all(-1)
        may[self._scans.unsolved()] = False
        gone = prune(self._graph, may, EDGES * poses)
        if len(gone):
            kept = np.ones(num, dtype=np.bool_)
            self._keep(kept, dict.fromkeys(gone.tolist(), -1), {})

    def _end(self, num: int) -> int:
        """Index up to which nothing needs the ``num`` keyframes as they are."""
        needed = self._scans.oldest_active
        return num - RECENT if needed is None else min(num - RECENT, needed)

    def _keep(
        self, kept: NDArray[np.bool_], edges: dict[int, int], poses: dict[int, int]
    ) -> Renumbering:
        """Let go of all poses but those (n,); edges and poses that go, to what stands for them."""
        recorded = np.zeros(len(self._graph.edges), dtype=np.bool_)
        of = [edges.get(k, k) for k in self._scans.closures.edges.tolist()]
        recorded[[k for k in of if k >= 0]] = True
        new = self._live.keep(kept, self._reflectors.keep_alive(), recorded)
        self._reflectors.renumber(new)
        self._scans.renumber(new, edges, poses)
        return new

    def _eliminate(self, poses: list[int]) -> tuple[dict[int, int], dict[int, tuple[int, Ties]]]:
        """What each edge of the poses went to, -1 if to none; and each pose, with its tie.

        One whose neighbours cannot be tied to one another stays.
        """
        edges: dict[int, int] = {}
        ties: dict[int, tuple[int, Ties]] = {}
        floor2 = np.array(self._p.scan_edge_variance_floor)
        e = self._graph.edges
        left = np.array(poses)
        while len(left):  # those with few neighbours first, which ties the fewest anew
            degrees = np.bincount(e.nodes[e.enabled].ravel(), minlength=int(left.max()) + 1)[left]
            gone = int(left[np.argmin(degrees)])
            left = left[left != gone]
            try:
                done = eliminate(self._graph, gone, floor2)
            except SolverError:
                continue
            ties[gone] = done.onto, done.tie
            edges.update(done.edges)
        for gone in reversed(ties):  # what it went to may have gone as well, but later
            onto, tie = ties[gone]
            if onto in ties:
                last, back = ties[onto]
                ties[gone] = last, back.then(tie)
        for first, last in reversed(edges.items()):
            edges[first] = edges.get(last, last)
        return edges, ties

    def _redundant(self, poses: Array, scan_stamps: list[int], end: int) -> dict[int, int]:
        """Keyframes before ``end`` that are not needed, each with the one whose scan it renews."""
        p, fixed = self._p, self._graph.fixed_poses
        out: dict[int, int] = {}
        if end <= self._judged:
            return out
        fresh = set(self._graph.edges.nodes[self._scans.unsolved()].ravel().tolist())
        near = cKDTree(poses[:end, :2]).query_ball_point(
            poses[self._judged : end, :2], p.place_distance
        )
        for k, others in enumerate(near, self._judged):
            if len(out) > p.optimize_every:  # more than come meanwhile, so that none waits long
                break
            if k in fresh:  # its neighbours are to be told of those closures as the solve has them
                break
            turns = np.abs(se2.wrap(poses[others, 2] - poses[k, 2]))
            same = [
                i for i, turn in zip(others, turns, strict=True)
                if i < k and i not in out and turn < p.place_heading
            ]  # fmt: skip
            if len(same) >= p.keyframes_per_place and not fixed[k]:
                out[k] = min(same, key=scan_stamps.__getitem__)
                scan_stamps[out[k]] = scan_stamps[k]
            self._judged += k not in out  # by the number that it will have
        return out


def remaining(keys: list[Keyframe], kept: NDArray[np.bool_]) -> list[Keyframe]:
    """The keyframes that are ``kept`` (n,), with their new numbers.

    No motion leads over one that jumped to the next one, either.
    """
    out: list[Keyframe] = []
    jumped = False
    for key, stays in zip(keys, kept.tolist(), strict=True):
        jumped |= key.jumped
        if stays:
            key.index, key.jumped, jumped = len(out), jumped, False
            out.append(key)
    return out
