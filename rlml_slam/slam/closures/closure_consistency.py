# SPDX-License-Identifier: Apache-2.0
"""Whether a scan that fits a submap may close a loop yet, or has to wait for others that agree.

Where rooms are alike, a scan fits in a wrong one as well as in its own. What tells them apart is
where the graph, of all odometry, scans and closures so far, expects the keyframe: the evidence
(graph/evidence.py) of that for the closure. What is far from there enters only with others that
agree with it around a short loop (pairwise consistency, Mangelson et al. 2018), seen from places
apart, for from one place a wrong room stays alike, and along a corridor or between racks for as
far as one sees there. The surer the graph, the more of them it takes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.robust.inlier_evidence import evidence
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]
APART = 1.0  # [m] between the places of two views that tell more than one
# Chance that a wrong place, alike in one view, is alike in the next one as well. Of the wrong
# matches of two real logs, fewer were.
ALIKE = 0.1
RISK = 0.1  # chances that any of the closures that wait agrees with another by accident


def is_consistent(
    live: OnlineSolver,
    nodes: Ints,
    deltas: Array,
    covs: Array,
    wrong: Array,
    odds: Array | float = 0.0,
    sight: Array | float = 0.0,
) -> NDArray[np.bool_]:
    """Which (k,) of the closures between poses (k, 2), none of them in a graph yet, may enter.

    ``deltas`` (k, 3) with ``covs`` (k, 3, 3) of their residuals; ``wrong`` (k,) is the log
    density of wrong errors, ``odds`` (k,) the logarithm of what else speaks for each, ``sight``
    (k,) [m] within which half of what each sees is. The graph is solved for it. Raises SolverError
    as Live.
    """
    graph, between = live.graph, _Between(live, np.unique(nodes))
    wrong = np.broadcast_to(wrong, len(nodes))
    i, j = nodes.T
    e = factors.relative_pose(graph.poses[i], graph.poses[j], deltas)[0]
    alone = evidence(e, between.covs(i, j) + covs, 1.0, wrong)
    agree = _agreement(graph, between, nodes, deltas, covs, wrong)
    sight, places = np.broadcast_to(sight, len(nodes)), graph.poses[:, :2]
    views = np.array([_views(places, j[row], sight[row]) for row in agree])
    # likelier right than wrong, had half of them been wrong beforehand: of matches it is 1 %
    return np.asarray(odds + alone - (views - 1) * math.log(ALIKE) > 0.0)


class _Between:
    """Covariances of where some poses of a graph are from one another."""

    def __init__(self, live: OnlineSolver, poses: Ints) -> None:
        n = len(poses)
        self._joint = live.joint(poses).reshape(n, 3, n, 3).swapaxes(1, 2)
        self._poses, self._at = live.graph.poses, poses

    def covs(self, i: Ints, j: Ints) -> Array:
        """Covariances (k, 3, 3) of the poses of j (k,) from i (k,), in the axes of j."""
        X_i, X_j = self._poses[i], self._poses[j]
        _, A, B = factors.relative_pose(X_i, X_j, se2.between(X_i, X_j))
        a, b = np.searchsorted(self._at, i), np.searchsorted(self._at, j)
        mixed = A @ self._joint[a, b] @ np.swapaxes(B, 1, 2)
        out: Array = mixed + np.swapaxes(mixed, 1, 2)
        for J, k in ((A, a), (B, b)):
            out = out + J @ self._joint[k, k] @ np.swapaxes(J, 1, 2)
        return out


def _agreement(
    graph: Graph, between: _Between, nodes: Ints, deltas: Array, covs: Array, wrong: Array
) -> NDArray[np.bool_]:
    """Whether (k, k) closures are likelier right together than not, itself included.

    The error of b is that against the way over a, T_ib_ia z_a T_ja_jb.
    """
    k = len(nodes)
    out = np.eye(k, dtype=np.bool_)
    a, b = np.triu_indices(k, 1)
    poses, (i, j) = graph.poses, nodes.T
    T_j = se2.between(poses[j[a]], poses[j[b]])
    rest = se2.compose(deltas[a], T_j)
    e = se2.between(deltas[b], se2.compose(se2.between(poses[i[b]], poses[i[a]]), rest))
    A, B = se2.adjoint(se2.inverse(T_j)), se2.adjoint(se2.inverse(rest))
    S = covs[b] + between.covs(j[a], j[b]) + A @ covs[a] @ np.swapaxes(A, 1, 2)
    S = S + B @ between.covs(i[b], i[a]) @ np.swapaxes(B, 1, 2)
    likelier = np.maximum(wrong[a], wrong[b])  # in the smaller area, accidents are
    out[a, b] = out[b, a] = evidence(e, S, 1.0, likelier) > math.log(k / RISK)
    return out


def _views(places: Array, poses: Ints, sight: Array) -> float:
    """How many views of their own the poses (k,) are, in the order of driving.

    The places (n, 2) are those of all poses, ``sight`` (k,) [m] as above. Half of what one sees
    lies behind as soon as one has gone as far as that is away: that is one view more. On the way
    there, a view tells its share of it.
    """
    poses, first = np.unique(poses, return_index=True)
    count, last = 1.0, places[poses[0]]
    for place, gap in zip(places[poses], sight[first].tolist(), strict=True):
        gone = math.dist(place, last)
        if gone >= APART:
            count, last = count + min(gone / max(gap, APART), 1.0), place
    return count
