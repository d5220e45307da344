# SPDX-License-Identifier: Apache-2.0
"""Bounds of the covariance of keyframes, from single paths of odometry and closures.

The graph takes the errors of its edges as independent. Over a long drive it averages out errors
of the wheels that last as long, and over many closures the errors that these share. The front end
estimates the lasting errors, but it has no closures of scans. Here, the covariance of a keyframe
is that of the front end along the driven path; a closure adds that of another path. The
correlation of the two is unknown, so they are fused by covariance intersection (Julier, Uhlmann
1997), which is consistent for any correlation.

Between two keyframes, the covariance grows as that of the front end. That is an approximation: the
true growth is smaller where a lasting error cancels (out and back on one path) and larger where it
accumulates. The result is used together with the graph's own covariance only
(:func:`correction.either`).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import Correction, ReferencePose, carried, either, positive
from rlml_slam.graph import FactorTable, Graph, OnlineSolver
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.keyframes import Keyframe

WEIGHTS = np.linspace(0.0, 1.0, 11)  # tried for covariance intersection


class PathCovariance:
    """Covariances (3, 3) of keyframes in the map, each in the axes of its own pose.

    Entries are kept for the keyframes at which closures end. Before and after an entry, the
    covariance grows as the front end's does.
    """

    def __init__(self) -> None:
        self._numbers: list[int] = []
        self._known: list[ReferencePose] = []  # entries, in the axes of the local frame
        self._starts: list[int] = []  # numbers of keyframes after a jump
        self._num_closures = 0  # closures below this number are included

    def cov(self, key: Keyframe) -> Array:
        """Covariance (3, 3) of a keyframe."""
        k = bisect_right(self._numbers, key.number)
        known = self._known[k - 1] if k else None
        _, cov = Correction(np.zeros(3), known).apply(key.T_local, key.cov_local)
        if k < len(self._numbers) and self._numbers[k] not in self._starts:
            later = self._known[k]
            lever = later.pose[:2] - key.T_local[:2]
            growth = positive(later.cov_local - carried(key.cov_local, lever))
            cov = intersection(cov, carried(later.cov_map + growth, -lever))
        return se2.rotate_cov(cov, -key.T_local[2])

    @property
    def newest(self) -> int:
        """Number of the last entry, -1 before the first."""
        return self._numbers[-1] if self._numbers else -1

    def start(self, key: Keyframe) -> None:
        """Start at a keyframe after a jump, with the covariance of its relocalization."""
        self._starts.append(key.number)
        self._enter(key, se2.rotate_cov(key.cov_local, -key.T_local[2]))

    def add_closures(
        self, closures: ClosureRecords, keys: Sequence[Keyframe], edges: FactorTable
    ) -> None:
        """Include new closures; ``keys`` are the keyframes by index."""
        new = [c for c in closures.accepted(self._num_closures) if edges.enabled[c.edge]]
        for c in sorted(new, key=lambda c: c.number):
            self._num_closures = c.number + 1
            T = edges.measured[c.edge]
            cov = se2.rotate_cov(carried(self.cov(keys[c.i]), T[:2]), -T[2])
            cov += np.linalg.inv(edges.information[c.edge])
            self._enter(keys[c.j], intersection(self.cov(keys[c.j]), cov))

    def remove_closures(self) -> None:
        """Closures were disabled or enabled: the enabled ones have to be added again."""
        at = [self._numbers.index(number) for number in self._starts]
        self._numbers, self._known = list(self._starts), [self._known[k] for k in at]
        self._num_closures = 0

    def keep(self, keys: Sequence[Keyframe]) -> None:
        """Remove entries that are not needed for the keyframes that are left.

        For each of these the last entry up to it and the first one after it are kept.
        """
        numbers = [key.number for key in keys]
        self._starts = [self._starts[k] for k in _ends(numbers, self._starts)]
        starts = [self._numbers.index(number) for number in self._starts]
        kept = sorted({*_ends(numbers, self._numbers), *starts})
        self._numbers = [self._numbers[k] for k in kept]
        self._known = [self._known[k] for k in kept]

    def _enter(self, key: Keyframe, cov: Array) -> None:
        known = ReferencePose(key.T_local, key.cov_local, se2.rotate_cov(cov, key.T_local[2]))
        k = bisect_right(self._numbers, key.number)
        self._numbers.insert(k, key.number)
        self._known.insert(k, known)


def _ends(numbers: Sequence[int], entries: Sequence[int]) -> list[int]:
    """Indices of the first and last of the ``entries`` between each two neighbouring ``numbers``.

    Both ascend; an entry at one of the ``numbers`` is before it.
    """
    gap = [bisect_left(numbers, entry) for entry in entries]
    last = len(entries) - 1
    return [
        k for k, g in enumerate(gap) if k in (0, last) or g != gap[k - 1] or g != gap[k + 1]
    ]  # fmt: skip


def newest_covariance(
    solver: OnlineSolver,
    bound: PathCovariance | None,
    closures: ClosureRecords,
    keys: Sequence[Keyframe],
    T_map_local: Array,
) -> ReferencePose:
    """Covariance of the newest keyframe in the map, after a solve.

    Its sightings are not in the graph yet: it is that of the keyframe before, grown by the front
    end's since. Where it was found again, that is the nearest one: it has the error of what is
    mapped there. The path covariance is a lower ``bound`` where no reflectors constrain the pose;
    None in a map with the frame of a survey.
    """
    before, last = keys[-2:]
    if last.jumped:
        way = solver.graph.poses[: last.index, :2] - solver.graph.poses[last.index, :2]
        before = keys[int(np.argmin(np.hypot(*way.T)))]
    cov = solver.joint([before.index])
    if bound is not None:
        bound.add_closures(closures, keys, solver.graph.edges)
        if not _is_constrained(solver.graph, bound, closures, keys, before):
            heading = float(T_map_local[2] + before.T_local[2])
            if last.jumped:  # its frame is not that of the robot now
                heading = float(solver.graph.poses[before.index, 2])
            cov = either(cov, se2.rotate_cov(bound.cov(before), heading))
    if last.jumped:
        way = solver.graph.poses[last.index, :2] - solver.graph.poses[before.index, :2]
        cov = carried(cov, way) + se2.rotate_cov(last.cov_local, float(T_map_local[2]))
        return ReferencePose(last.T_local, last.cov_local, cov)
    since = Correction(T_map_local, ReferencePose(before.T_local, before.cov_local, cov))
    _, cov_map = since.apply(last.T_local, last.cov_local)
    return ReferencePose(last.T_local, last.cov_local, cov_map)


def _is_constrained(
    graph: Graph,
    covariance: PathCovariance,
    closures: ClosureRecords,
    keys: Sequence[Keyframe],
    key: Keyframe,
) -> bool:
    """Whether reflectors that were mapped at the last closure constrain a keyframe."""
    if not graph.edges.enabled[closures.edges].any():
        return False
    until = bisect_right(keys, covariance.newest, key=lambda k: k.number) - 1
    return is_constrained_by_reflectors(graph.sightings, key.index, until)


def is_constrained_by_reflectors(sightings: FactorTable, pose: int, until: int) -> bool:
    """Whether at least two reflectors seen at a pose were also seen at poses up to ``until``.

    They constrain all three coordinates, without odometry in between.
    """
    until = min(until, pose - 1)
    poses, landmarks = sightings.nodes[sightings.enabled].T
    return len(np.intersect1d(landmarks[poses == pose], landmarks[poses <= until])) >= 2


def intersection(P: Array, Q: Array) -> Array:
    """(w P^-1 + (1 - w) Q^-1)^-1 of covariances (3, 3), with the w for which it is smallest."""
    if np.linalg.det(P) <= 0.0:  # of the first pose, which is fixed
        return P
    A, B = np.linalg.inv(P), np.linalg.inv(Q)
    mixed = WEIGHTS[:, None, None] * A + (1.0 - WEIGHTS)[:, None, None] * B
    best: Array = mixed[int(np.argmax(np.linalg.det(mixed)))]
    return np.asarray(np.linalg.inv(best))
