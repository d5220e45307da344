# SPDX-License-Identifier: Apache-2.0
"""Which closures to believe: the surest first, the others by the graph that these have made.

A wrong closure cannot be told by its residual once it has bent the map, and robust losses that
start with all closures in the graph settle in whatever they are bent into. So the graph begins
with odometry alone. A closure, or a group that agrees (agreement.py), enters when the evidence
(evidence.py) of the graph so far is far above chance; each that enters sharpens the prediction for
the others. The demands sink only when nothing meets them, down to a 5 % chance of being wrong.
In the end each that is inside is judged once more, by all the others (``_review``).
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
SURE = 0.01  # chances that any of all closures is wrong, with which the first ones enter
GROUPS = 0.1  # the same for the groups, whose members speak for each other already
DOUBT = 0.05  # chance of being wrong with which the last one enters
STEP = 2.0  # by which the demands sink
TRIES = 2  # times that a closure may be thrown out again
# times that all are judged in the end, each as long as a solve: far more than it takes where
# closures do not take turns
ROUNDS = 50


@dataclass(frozen=True)
class Selection:
    """``edges`` (k,) are the closures, ``accepted`` (k,) whether they are in the graph.

    ``evidence`` (k,) is the log ratio of right to wrong when each was judged last, infinite for
    one that alone holds two parts together. ``scale`` of the covariances, as found.
    """

    edges: Ints
    accepted: Flags
    evidence: Array
    scale: float
    solves: int


def select_closures(
    graph: Graph, parameters: params.Solver | None = None, barred: Ints | None = None
) -> Selection:
    """Enable the closures to believe and disable all others; the estimate is the optimum then.

    The edges ``barred`` stay out in any case. All other factors are trusted. Raises
    SolverError like ``optimize``.
    """
    losses = graph.losses
    graph.losses = replace(losses, closure=Loss())
    try:
        return _Selector(graph, parameters or params.Solver(), barred).run()
    finally:
        graph.losses = losses


class _Selector:
    def __init__(self, graph: Graph, parameters: params.Solver, barred: Ints | None) -> None:
        e = graph.edges
        self._graph, self._parameters = graph, parameters
        is_closure = e.kinds == FactorKind.CLOSURE
        self._edges = np.flatnonzero(is_closure)
        may = np.isin(self._edges, [] if barred is None else barred, invert=True)
        self._may = may
        self._nodes, self._z = e.nodes[self._edges], e.measured[self._edges]
        self._cov = np.asarray(np.linalg.inv(e.information[self._edges]), dtype=np.float64)
        trusted = np.flatnonzero(e.enabled & ~is_closure)
        spanning_forest = SpanningForest(graph, trusted)
        area = extent2(spanning_forest.poses)
        self._groups = group(spanning_forest, self._nodes, self._z, self._cov, area)
        self._held = _bridges(spanning_forest, self._nodes, self._groups, may)
        if self._held.any():
            held = self._edges[self._held]
            spanning_forest = SpanningForest(graph, np.concatenate([trusted, held]))
            area = extent2(spanning_forest.poses)
        self._wrong = uniform(area)
        free = ~graph.fixed_poses
        graph.poses[free] = spanning_forest.poses[free]
        self._accepted = self._held.copy()
        self._left = np.where(may & ~self._held, TRIES, 0)
        self._evidence = np.where(self._held, np.inf, -np.inf)
        self._backbone = spanning_forest
        self._solves = 0

    def run(self) -> Selection:
        """Let closures in, then judge all of them again."""
        self._grow()
        self._review()
        return Selection(
            self._edges, self._accepted, self._evidence, self._groups.scale, self._solves
        )

    def _grow(self) -> None:
        """Let closures in until none of those outside is likelier right than wrong."""
        self._solve()
        self._judge_first()
        sunk = 0.0
        while True:
            new = self._enough(sunk)
            if new.any():
                self._take(new)
                self._judge()
                sunk = max(sunk - STEP, 0.0)
            elif sunk >= self._lowest():
                break
            else:
                sunk += STEP

    def _lowest(self) -> float:
        """How far the demands may sink: to where one that enters is wrong with the chance DOUBT.

        The odds beforehand are those of the closures outside and inside.
        """
        inside = int(self._accepted.sum())
        odds = (len(self._edges) - inside + 1.0) / (inside + 1.0)
        return self._strict() - math.log(odds / DOUBT)

    def _of_groups(self, several: Flags, sunk: float) -> float:
        """Demand of the groups: as of single ones, by the odds of groups, and never below 0."""
        label, size, _ = self._groups
        num = int(several.sum())
        strict = math.log(max(num, 1) / GROUPS)
        inside = int((several & (np.bincount(label, self._accepted, len(size)) > 0.0)).sum())
        last = math.log((num - inside + 1.0) / (inside + 1.0) / DOUBT)
        return max(min(strict, max(strict - sunk, last)), 0.0)

    def _strict(self) -> float:
        return math.log(max(len(self._edges), 1) / SURE)

    def _enough(self, sunk: float) -> Flags:
        """Closures outside whose evidence, or that of the best of their group, is enough."""
        label, size, _ = self._groups
        sunk = min(sunk, self._lowest())
        outside = ~self._accepted & (self._left > 0)
        value = np.where(outside, self._evidence, -np.inf)
        best = np.full(len(size), -np.inf)
        np.maximum.at(best, label, value)
        several = size > 1
        grouped: Flags = (several & (best > self._of_groups(several, sunk)))[label]
        return outside & ((value > self._strict() - sunk) | grouped)

    def _take(self, new: Flags) -> None:
        """Let closures in, and throw out what the graph cannot agree with."""
        self._accepted |= new
        self._solve()
        now = self._weigh(self._errors(np.arange(len(self._edges))), self._cov)
        bad = self._accepted & ~self._held & (now < 0.0)
        if bad.any():
            self._evidence[bad] = now[bad]
            self._left[bad] -= 1
            self._accepted &= ~bad
            self._solve()

    def _solve(self) -> None:
        self._graph.edges.enabled[self._edges] = self._accepted
        optimize(self._graph, self._parameters)
        self._solves += 1

    def _judge_first(self) -> None:
        """Evidence by the backbone alone."""
        outside = np.flatnonzero(~self._held)
        i, j = self._nodes[outside].T
        T, S = self._backbone.motion(i, j)
        e = se2.between(self._z[outside], T)
        self._evidence[outside] = self._weigh(e, S + self._cov[outside])

    def _judge(self) -> None:
        """Evidence of those outside by the graph as it is: roughly, and exactly where it counts.

        The covariance of a difference is at most twice the sum of both, which no correlation
        needs to be known for; what fails even so need not be looked at.
        """
        outside = np.flatnonzero(~self._accepted & (self._left > 0))
        if not len(outside):
            return
        poses = self._graph.poses
        i, j = self._nodes[outside].T
        e = self._errors(outside)
        marginals = Marginals(self._graph)
        rough = self._roughly(marginals, outside)
        # the true covariance is smaller: its density is lower at a large error, higher at none
        open_ = np.flatnonzero((rough > -STEP) & (rough < self._strict() + STEP))
        if len(open_):
            S = difference_covs(marginals, poses, i[open_], j[open_])
            rough[open_] = self._weigh(e[open_], S + self._cov[outside[open_]])
        self._evidence[outside] = rough

    def _errors(self, of: Ints) -> Array:
        """Residuals (k, 3) of the closures ``of`` (k,) by the graph as it is."""
        poses = self._graph.poses
        i, j = self._nodes[of].T
        return factors.relative_pose(poses[i], poses[j], self._z[of])[0]

    def _roughly(self, marginals: Marginals, outside: Ints) -> Array:
        i, j = self._nodes[outside].T
        S = most_difference_covs(marginals, self._graph.poses, i, j)
        return self._weigh(self._errors(outside), S + self._cov[outside])

    def _review(self) -> None:
        """Judge those inside by the others, and those outside again, until nothing changes.

        What entered early was judged by a graph that knew little. Now all can be judged by what
        all the others say, and by errors as they have turned out to be (calibration.py). Of those
        that fail, the ones likelier wrong than right go at once; otherwise the worst goes alone,
        as two that contradict each other need not both be wrong. After ``ROUNDS`` times all that
        are in doubt go, and none comes back.
        """
        self._left = np.where(self._may & ~self._held, TRIES, 0)
        for left in range(ROUNDS, -1, -1):
            judged, evidence = self._judge_again()
            demand = self._strict() - self._lowest()
            doubt = judged & self._accepted & (evidence < demand)
            back = judged & ~self._accepted & (evidence > demand)
            self._evidence[judged] = evidence[judged]
            if doubt.any():
                worst = evidence[doubt].min()
                out = doubt & (evidence <= max(worst, 0.0)) if left else doubt
                self._left[out] -= 1
                self._accepted &= ~out
            elif back.any() and left:
                self._accepted |= back
            else:
                return
            self._solve()

    def _judge_again(self) -> tuple[Flags, Array]:
        """(Which closures are judged, evidence of those), each by all others that are inside."""
        outside = np.flatnonzero(~self._accepted & (self._left > 0))
        inside = np.flatnonzero(self._accepted & ~self._held)
        marginals = Marginals(self._graph)
        outside = outside[self._roughly(marginals, outside) > -STEP]
        i, j = self._nodes[outside].T
        e_out = self._errors(outside)
        S_out = difference_covs(marginals, self._graph.poses, i, j) + self._cov[outside]
        e_in, S_in = left_out(self._graph, marginals, self._edges[inside])
        both = np.concatenate([inside, outside])
        e, S = np.concatenate([e_in, e_out]), np.concatenate([S_in, S_out])
        scale = self._groups.scale
        wrong = near_by(self._graph.poses, self._z[inside], scale * S_in)
        judged, values = np.zeros(len(self._edges), np.bool_), np.zeros(len(self._edges))
        if len(both):
            calibration = calibrate(e, S, scale, wrong)
            judged[both], values[both] = True, calibration.evidence(e, S, wrong)
        return judged, values

    def _weigh(self, e: Array, S: Array) -> Array:
        return evidence(e, S, self._groups.scale, self._wrong)


def _bridges(spanning_forest: SpanningForest, nodes: Ints, groups: Groups, may: Flags) -> Flags:
    """Closures that hold pieces of the backbone together: from the largest groups, no loops."""
    held = np.zeros(len(nodes), dtype=np.bool_)
    if spanning_forest.pieces == 1:
        return held
    a, b = np.sort(spanning_forest.piece[nodes], axis=1).T
    order = np.lexsort((-groups.size[groups.label], b, a))
    order = order[(a[order] != b[order]) & may[order]]
    pairs, first = np.unique(np.stack([a[order], b[order]], -1), axis=0, return_index=True)
    chosen = order[first]
    cost = 1.0 / groups.size[groups.label[chosen]]
    n = spanning_forest.pieces
    links = sparse.csr_matrix((cost, (pairs[:, 0], pairs[:, 1])), (n, n))
    rows, cols = sparse.csgraph.minimum_spanning_tree(links).nonzero()
    tree = set(zip(rows.tolist(), cols.tolist(), strict=True))
    held[[k for k, pair in zip(chosen, pairs.tolist(), strict=True) if tuple(pair) in tree]] = True
    return held
