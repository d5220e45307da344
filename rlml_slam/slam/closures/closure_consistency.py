# SPDX-License-Identifier: Apache-2.0
"""Consistency check of loop closures before they are added to the graph.

In buildings with similar rooms a scan fits in a wrong room as well as in its own. The evidence is
the log likelihood ratio of correct to wrong matches, given where the graph expects the keyframe
(graph/robust/inlier_evidence.py). A closure far from there is added only with others that agree
with it around a short loop (pairwise consistency: Mangelson et al. 2018) and that were seen from
other viewpoints: from one viewpoint, a similar room stays similar. The smaller the covariance of
the graph, the more such closures are required.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph import Graph, OnlineSolver, evidence, relative_pose
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]
MIN_BASELINE = 1.0  # [m] between two viewpoints that count as more than one
# Probability that a wrong place which fits from one viewpoint also fits from the next one; among
# the wrong matches of two real logs the share was lower.
REPEATED_WRONG = 0.1
FALSE_AGREEMENT = 0.1  # expected number of accidental agreements among the pending closures


def is_consistent(
    solver: OnlineSolver,
    nodes: Ints,
    deltas: Array,
    covs: Array,
    wrong: Array,
    log_odds: Array | float = 0.0,
    view_range: Array | float = 0.0,
    weak: NDArray[np.bool_] | bool = False,
) -> NDArray[np.bool_]:
    """Whether (k,) closures between poses (k, 2) that are not in the graph yet may be added.

    ``deltas`` (k, 3) with covariances ``covs`` (k, 3, 3) of their residuals; ``wrong`` (k,) is the
    log density of the errors of wrong matches, ``log_odds`` (k,) further evidence for each, and
    ``view_range`` (k,) [m] the median range of each scan; ``weak`` (k,) are those of weak matches.
    Solves the graph for its covariances. Raises SolverError like OnlineSolver.
    """
    graph, between = solver.graph, _RelativeCovariance(solver, np.unique(nodes))
    wrong = np.broadcast_to(wrong, len(nodes))
    i, j = nodes.T
    e = relative_pose(graph.poses[i], graph.poses[j], deltas)[0]
    alone = evidence(e, between.covs(i, j) + covs, 1.0, wrong)
    # a weak or wide match may not enter alone, wherever the graph expects it
    alone = np.where(weak, np.minimum(alone, 0.0), alone)
    agree = _agreement(graph, between, nodes, deltas, covs, wrong)
    ranges, positions = np.broadcast_to(view_range, len(nodes)), graph.poses[:, :2]
    views = np.array([_num_viewpoints(positions, j[row], ranges[row]) for row in agree])
    # prior odds 1 : 1; of verified matches about 1 % are wrong
    return np.asarray(log_odds + alone - (views - 1) * math.log(REPEATED_WRONG) > 0.0)


class _RelativeCovariance:
    """Covariances of the relative poses between some poses of a graph."""

    def __init__(self, solver: OnlineSolver, poses: Ints) -> None:
        n = len(poses)
        self._joint = solver.joint(poses).reshape(n, 3, n, 3).swapaxes(1, 2)
        self._poses, self._indices = solver.graph.poses, poses

    def covs(self, i: Ints, j: Ints) -> Array:
        """Covariances (k, 3, 3) of the poses j (k,) relative to i (k,), in the axes of j."""
        X_i, X_j = self._poses[i], self._poses[j]
        _, A, B = relative_pose(X_i, X_j, se2.between(X_i, X_j))
        a, b = np.searchsorted(self._indices, i), np.searchsorted(self._indices, j)
        mixed = A @ self._joint[a, b] @ np.swapaxes(B, 1, 2)
        out: Array = mixed + np.swapaxes(mixed, 1, 2)
        for J, k in ((A, a), (B, b)):
            out = out + J @ self._joint[k, k] @ np.swapaxes(J, 1, 2)
        return out


def _agreement(
    graph: Graph,
    between: _RelativeCovariance,
    nodes: Ints,
    deltas: Array,
    covs: Array,
    wrong: Array,
) -> NDArray[np.bool_]:
    """Pairwise consistency (k, k) of closures, true on the diagonal.

    The error of b is its difference from the path over a, T_ib_ia z_a T_ja_jb.
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
    density = np.maximum(wrong[a], wrong[b])  # that of the smaller search area
    out[a, b] = out[b, a] = evidence(e, S, 1.0, density) > math.log(k / FALSE_AGREEMENT)
    return out


def _num_viewpoints(positions: Array, poses: Ints, ranges: Array) -> float:
    """Number of independent viewpoints of the poses (k,), in the order of driving.

    ``positions`` (n, 2) are those of all poses, ``ranges`` (k,) [m] the median ranges of the
    scans. A viewpoint counts as a new one after a travel of the median range, and as a share of
    one before.
    """
    poses, first = np.unique(poses, return_index=True)
    count, last = 1.0, positions[poses[0]]
    for position, median in zip(positions[poses], ranges[first].tolist(), strict=True):
        travel = math.dist(position, last)
        if travel >= MIN_BASELINE:
            count, last = count + min(travel / max(median, MIN_BASELINE), 1.0), position
    return count
