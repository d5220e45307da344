# SPDX-License-Identifier: Apache-2.0
"""Selection of loop closures: the most certain first, the others by the graph these have made.

The residual of a wrong closure does not show it once it has bent the map, and robust losses that
start with all closures in the graph converge to whatever these bend it into. So the graph begins
with odometry alone. A closure, or a pairwise-consistent group (pairwise_consistency.py), enters
when its log evidence (inlier_evidence.py) by the graph so far is far above chance; each that
enters makes the prediction for the others more certain. The thresholds are lowered only when no
closure meets them, down to a 5 % chance of being wrong. In the end each accepted closure is tested
once more, against all the others (``_review``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rlml_slam import params, se2
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss
from rlml_slam.graph.robust.inlier_evidence import evidence, extent2, near_by, uniform
from rlml_slam.graph.robust.noise_calibration import calibrate
from rlml_slam.graph.robust.pairwise_consistency import Groups, group
from rlml_slam.graph.robust.relative_covariance import (
    difference_covs,
    left_out,
    most_difference_covs,
)
from rlml_slam.graph.robust.spanning_forest import Ints, SpanningForest
from rlml_slam.se2 import Array

Flags = NDArray[np.bool_]
FIRST_RISK = 0.01  # chance that any of all closures is wrong, at which the first ones enter
GROUP_RISK = 0.1  # the same for the groups, whose members are consistent with each other already
LAST_RISK = 0.05  # chance of being wrong at which the last one enters
STEP = 2.0  # [nats] by which the thresholds are lowered
TRIES = 2  # number of times that a closure may be rejected after it was accepted
# reviews at most, each as long as a solve: far more than it takes unless closures alternate
ROUNDS = 50


@dataclass(frozen=True)
class Selection:
    """``edges`` (k,) are the closures, ``accepted`` (k,) whether they are in the graph.

    ``evidence`` (k,) is the log ratio of right to wrong when each was tested last, infinite for
    one that alone connects two parts. ``scale`` of the covariances, as found or the least.
    """

    edges: Ints
    accepted: Flags
    evidence: Array
    scale: float


def select_closures(
    graph: Graph, parameters: params.Solver | None = None, excluded: Ints | None = None,
    least_scale: float = 0.0,
) -> Selection:  # fmt: skip
    """Enable the consistent closures and disable all others.

    The edges ``excluded`` stay disabled in any case. All other factors are trusted: odometry and
    scan edges have no robust loss here, and the estimate is the optimum of that. Their
    covariances are scaled as short loops show, by ``least_scale`` at least: short loops do not
    show the errors of a long way that come from a few places. Raises SolverError like
    ``optimize``.
    """
    losses = graph.losses
    # a robust loss would let a wrong closure tear the way apart, and then all would fit
    graph.losses = replace(losses, closure=Loss(), odometry=Loss(), scan=Loss())
    try:
        return _Selector(graph, parameters or params.Solver(), excluded, least_scale).run()
    finally:
        graph.losses = losses


class _Selector:
    def __init__(
        self, graph: Graph, parameters: params.Solver, excluded: Ints | None, least_scale: float
    ) -> None:
        e = graph.edges
        self._graph, self._parameters = graph, parameters
        is_closure = e.kinds == FactorKind.CLOSURE
        self._edges = np.flatnonzero(is_closure)
        allowed = np.isin(self._edges, [] if excluded is None else excluded, invert=True)
        self._allowed = allowed
        self._nodes, self._z = e.nodes[self._edges], e.measured[self._edges]
        self._cov = np.asarray(np.linalg.inv(e.information[self._edges]), dtype=np.float64)
        trusted = np.flatnonzero(e.enabled & ~is_closure)
        spanning_forest = SpanningForest(graph, trusted)
        area = extent2(spanning_forest.poses)
        self._groups = group(spanning_forest, self._nodes, self._z, self._cov, area)
        self._scale = max(self._groups.scale, least_scale)
        self._bridges = _bridges(spanning_forest, self._nodes, self._groups, allowed)
        if self._bridges.any():
            bridges = self._edges[self._bridges]
            spanning_forest = SpanningForest(graph, np.concatenate([trusted, bridges]))
            area = extent2(spanning_forest.poses)
        self._wrong = uniform(area)
        free = ~graph.fixed_poses
        graph.poses[free] = spanning_forest.poses[free]
        self._accepted = self._bridges.copy()
        self._left = np.where(allowed & ~self._bridges, TRIES, 0)
        self._evidence = np.where(self._bridges, np.inf, -np.inf)
        self._forest = spanning_forest

    def run(self) -> Selection:
        """Accept closures, then review all of them."""
        self._grow()
        self._review()
        return Selection(self._edges, self._accepted, self._evidence, self._scale)

    def _grow(self) -> None:
        """Accept closures until none of the rest is more likely right than wrong."""
        self._solve()
        self._evaluate_by_forest()
        lowered = 0.0
        while True:
            new = self._above_threshold(lowered)
            if new.any():
                self._accept(new)
                self._evaluate_rest()
                lowered = max(lowered - STEP, 0.0)
            elif lowered >= self._max_lowering():
                break
            else:
                lowered += STEP

    def _max_lowering(self) -> float:
        """How far the thresholds may be lowered: to where an accepted one is wrong with LAST_RISK.

        The prior odds are those of the rejected to the accepted closures.
        """
        inside = int(self._accepted.sum())
        odds = (len(self._edges) - inside + 1.0) / (inside + 1.0)
        return self._first_threshold() - math.log(odds / LAST_RISK)

    def _group_threshold(self, several: Flags, lowered: float) -> float:
        """Threshold of the groups: as of single ones, by the odds of groups, and never below 0."""
        label, size, _ = self._groups
        num = int(several.sum())
        strict = math.log(max(num, 1) / GROUP_RISK)
        inside = int((several & (np.bincount(label, self._accepted, len(size)) > 0.0)).sum())
        last = math.log((num - inside + 1.0) / (inside + 1.0) / LAST_RISK)
        return max(min(strict, max(strict - lowered, last)), 0.0)

    def _first_threshold(self) -> float:
        return math.log(max(len(self._edges), 1) / FIRST_RISK)

    def _above_threshold(self, lowered: float) -> Flags:
        """Closures not accepted yet whose evidence, or that of their group, is above threshold."""
        label, size, _ = self._groups
        lowered = min(lowered, self._max_lowering())
        outside = ~self._accepted & (self._left > 0)
        value = np.where(outside, self._evidence, -np.inf)
        best = np.full(len(size), -np.inf)
        np.maximum.at(best, label, value)
        several = size > 1
        grouped: Flags = (several & (best > self._group_threshold(several, lowered)))[label]
        return outside & ((value > self._first_threshold() - lowered) | grouped)

    def _accept(self, new: Flags) -> None:
        """Accept closures, and reject those that contradict the graph then."""
        self._accepted |= new
        self._solve()
        now = self._evidence_of(self._errors(np.arange(len(self._edges))), self._cov)
        bad = self._accepted & ~self._bridges & (now < 0.0)
        if bad.any():
            self._evidence[bad] = now[bad]
            self._left[bad] -= 1
            self._accepted &= ~bad
            self._solve()

    def _solve(self) -> None:
        self._graph.edges.enabled[self._edges] = self._accepted
        optimize(self._graph, self._parameters)

    def _evaluate_by_forest(self) -> None:
        """Evidence by the spanning forest of the trusted edges alone."""
        outside = np.flatnonzero(~self._bridges)
        i, j = self._nodes[outside].T
        T, S = self._forest.motion(i, j)
        e = se2.between(self._z[outside], T)
        self._evidence[outside] = self._evidence_of(e, S + self._cov[outside])

    def _evaluate_rest(self) -> None:
        """Evidence of the others by the current graph: a bound, and exactly near a threshold.

        The covariance of a difference is at most twice the sum of both, whatever the
        correlation; what fails even with that bound needs no exact covariance.
        """
        outside = np.flatnonzero(~self._accepted & (self._left > 0))
        if not len(outside):
            return
        poses = self._graph.poses
        i, j = self._nodes[outside].T
        e = self._errors(outside)
        marginals = Marginals(self._graph)
        bound = self._evidence_bound(marginals, outside)
        # the true covariance is smaller: its density is lower at a large error, higher at a small
        open_ = np.flatnonzero((bound > -STEP) & (bound < self._first_threshold() + STEP))
        if len(open_):
            S = difference_covs(marginals, poses, i[open_], j[open_])
            bound[open_] = self._evidence_of(e[open_], S + self._cov[outside[open_]])
        self._evidence[outside] = bound

    def _errors(self, of: Ints) -> Array:
        """Residuals (k, 3) of the closures ``of`` (k,) by the graph as it is."""
        poses = self._graph.poses
        i, j = self._nodes[of].T
        return factors.relative_pose(poses[i], poses[j], self._z[of])[0]

    def _evidence_bound(self, marginals: Marginals, outside: Ints) -> Array:
        i, j = self._nodes[outside].T
        S = most_difference_covs(marginals, self._graph.poses, i, j)
        return self._evidence_of(self._errors(outside), S + self._cov[outside])

    def _review(self) -> None:
        """Test each accepted closure against the others, and the rejected ones again.

        What entered early was tested by a graph with few closures. Now all are tested by all the
        others, with the errors calibrated on themselves (noise_calibration.py). Of those that
        fail, the ones more likely wrong than right are rejected at once; otherwise the worst one
        alone, as two that contradict each other need not both be wrong. After ``ROUNDS`` times
        all that fail are rejected, and none is accepted again.
        """
        self._left = np.where(self._allowed & ~self._bridges, TRIES, 0)
        for left in range(ROUNDS, -1, -1):
            tested, evidence = self._evaluate_all()
            threshold = self._first_threshold() - self._max_lowering()
            failed = tested & self._accepted & (evidence < threshold)
            back = tested & ~self._accepted & (evidence > threshold)
            self._evidence[tested] = evidence[tested]
            if failed.any():
                worst = evidence[failed].min()
                out = failed & (evidence <= max(worst, 0.0)) if left else failed
                self._left[out] -= 1
                self._accepted &= ~out
            elif back.any() and left:
                self._accepted |= back
            else:
                return
            self._solve()

    def _evaluate_all(self) -> tuple[Flags, Array]:
        """(Closures tested, their evidence), each by all other accepted ones."""
        outside = np.flatnonzero(~self._accepted & (self._left > 0))
        inside = np.flatnonzero(self._accepted & ~self._bridges)
        marginals = Marginals(self._graph)
        outside = outside[self._evidence_bound(marginals, outside) > -STEP]
        i, j = self._nodes[outside].T
        e_out = self._errors(outside)
        S_out = difference_covs(marginals, self._graph.poses, i, j) + self._cov[outside]
        e_in, S_in = left_out(self._graph, marginals, self._edges[inside])
        both = np.concatenate([inside, outside])
        e, S = np.concatenate([e_in, e_out]), np.concatenate([S_in, S_out])
        scale = self._scale
        wrong = near_by(self._graph.poses, self._z[inside], scale * S_in)
        tested, values = np.zeros(len(self._edges), np.bool_), np.zeros(len(self._edges))
        if len(both):
            calibration = calibrate(e, S, scale, wrong)
            tested[both], values[both] = True, calibration.evidence(e, S, wrong)
        return tested, values

    def _evidence_of(self, e: Array, S: Array) -> Array:
        return evidence(e, S, self._scale, self._wrong)


def _bridges(forest: SpanningForest, nodes: Ints, groups: Groups, allowed: Flags) -> Flags:
    """Closures that connect pieces of the spanning forest: from the largest groups, no loops."""
    bridges = np.zeros(len(nodes), dtype=np.bool_)
    if forest.pieces == 1:
        return bridges
    a, b = np.sort(forest.piece[nodes], axis=1).T
    order = np.lexsort((-groups.size[groups.label], b, a))
    order = order[(a[order] != b[order]) & allowed[order]]
    pairs, first = np.unique(np.stack([a[order], b[order]], -1), axis=0, return_index=True)
    chosen = order[first]
    cost = 1.0 / groups.size[groups.label[chosen]]
    n = forest.pieces
    links = sparse.csr_matrix((cost, (pairs[:, 0], pairs[:, 1])), (n, n))
    rows, cols = sparse.csgraph.minimum_spanning_tree(links).nonzero()
    tree = set(zip(rows.tolist(), cols.tolist(), strict=True))
    bridges[chosen[[tuple(pair) in tree for pair in pairs.tolist()]]] = True
    return bridges
