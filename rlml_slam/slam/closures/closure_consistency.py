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
# share of the log odds of a weak match that its support for others lacks: where a place need not
# fit well, a wrong one fits again more often
REPEATED_WEAK = 0.75
ROUNDING = 1e-9  # of log odds that are to be 0
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
    # a weak or wide match may not enter alone, wherever the graph expects it, nor with a second
    # one from nearly the same viewpoint: its prior odds ask for one whole viewpoint more
    alone = np.where(weak, np.minimum(alone, 0.0) + math.log(REPEATED_WRONG), alone)
    agree = _agreement(graph, between, nodes, deltas, covs, wrong)
    odds = np.broadcast_to(log_odds, len(nodes))
    ranges, positions = np.broadcast_to(view_range, len(nodes)), graph.poses[:, :2]
    together = _together(positions, j, ranges, np.minimum(odds, 0.0), agree)
    # prior odds 1 : 1 of all others; of verified matches about 1 % are wrong
    return np.asarray(np.maximum(odds, 0.0) + alone + together > -ROUNDING)


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


def _together(
    positions: Array, poses: Ints, ranges: Array, odds: Array, agree: NDArray[np.bool_]
) -> Array:
    """Log odds (k,) of each match with those that agree with it (k, k); others as _log_odds.

    Matches that are weaker than one are left out where that is better for it: they never harm.
    """
    out = np.empty(len(poses))
    for row in np.unique(agree, axis=0):
        of = np.flatnonzero((agree == row).all(axis=1))
        least = np.unique(odds[row])
        parts = [row & (odds >= weakest) for weakest in least]
        each = [_log_odds(positions, poses[p], ranges[p], odds[p]) for p in parts]
        out[of] = np.maximum.accumulate(each)[np.searchsorted(least, odds[of])]
    return out


def _log_odds(positions: Array, poses: Ints, ranges: Array, odds: Array) -> float:
    """Log odds of matches that agree, of the poses (k,), eq. 58: their sum over viewpoints.

    ``positions`` (n, 2) are those of all poses, ``ranges`` (k,) [m] the median ranges of the
    scans, ``odds`` (k,) the log odds of each match alone, at most 0. In the order of driving, a
    viewpoint counts as a new one after a travel of the median range, and as a share of one before.
    Of the matches from one viewpoint the best counts.
    """
    shares, best, last = list[float](), list[float](), positions[poses.min()]
    for k in np.argsort(poses, kind='stable').tolist():
        travel = math.dist(positions[poses[k]], last)
        if not shares or travel >= MIN_BASELINE:
            shares.append(min(travel / max(float(ranges[k]), MIN_BASELINE), 1.0))
            best.append(-math.inf)
            last = positions[poses[k]]
        best[-1] = max(best[-1], float(odds[k]))
    further = [
        u * (REPEATED_WEAK * b - math.log(REPEATED_WRONG))
        for u, b in zip(shares, best, strict=True)
    ]
    return best[0] + sum(further[1:])
