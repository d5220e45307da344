# SPDX-License-Identifier: Apache-2.0
"""The estimate of a graph that a robot adds to, kept at the optimum: what changed is solved.

The common keyframe is a step or some of the incremental solver, which cost what it touches. The
batch solver does what that cannot: it looks for another start where this one is bad, and never
ends above it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam import params
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.solver import BAD_START, DEFAULT, optimize
from rlml_slam.graph.incremental.incremental_solver import IncrementalSolver
from rlml_slam.graph.model.cost import total_cost
from rlml_slam.graph.model.graph import Graph, Renumbering
from rlml_slam.se2 import Array

# Steps that are made without a look at the cost of the whole graph, and in all: then the batch
# solver takes over, which needs fewer from a start that is no bad one.
FEW, MOST = 5, 40
# Share of the cost that is too little to go on for. Robust weights may come to rest slowly: where
# each step brings 0.9 of what the last one did, this leaves a tenth of 0.1 %, to be taken up when
# more comes.
LITTLE = 1e-5


class OnlineSolver:
    """Solves ``graph`` and tells covariances of it; ``steps`` and ``batches`` count what it took.

    Who moves the estimate itself has to say so by ``start_over``.
    """

    def __init__(self, graph: Graph, parameters: params.Solver = DEFAULT) -> None:
        self.graph = graph
        self.steps = self.batches = 0
        self._p = parameters
        self._incremental = IncrementalSolver(graph)
        self._at_rest = False  # the last solve ended, and no step came since
        # the estimate of the solver, where the graph shows an older one until the next solve
        self._ahead: tuple[Array, Array] | None = None

    def solve(self) -> None:
        """Bring the estimate to the optimum; raises SolverError as the solvers do."""
        self._catch_up()
        if self._at_rest and self._incremental.is_current:
            return
        graph = self.graph
        before = graph.poses.copy(), graph.landmarks.copy()
        try:
            self._at_rest = self._descend(before)
        except SolverError:
            self._at_rest = False  # where the graph itself is to blame, the batch solver says so
        if not self._at_rest:
            graph.poses[:], graph.landmarks[:] = before
            self.solve_all()

    def _catch_up(self) -> None:
        """Show what was solved on the side."""
        if self._ahead is not None:
            poses, landmarks = self._ahead
            self.graph.poses[: len(poses)] = poses
            self.graph.landmarks[: len(landmarks)] = landmarks
            self._ahead = None

    def _descend(self, before: tuple[Array, Array]) -> bool:
        """Steps until the optimum is reached, or False where they do not lead there."""
        graph = self.graph
        self._step()
        if self._incremental.settled:
            return True  # linear models that still hold: the cost is where they say
        start, num = total_cost(graph.tables(), *before)
        cost, steps = start, 1
        while start <= BAD_START * num and steps < MOST and cost <= start:
            self._step()
            steps += 1
            if self._incremental.settled:
                return True
            if steps >= FEW:
                last, cost = cost, total_cost(graph.tables(), graph.poses, graph.landmarks)[0]
                if abs(last - cost) <= LITTLE * cost:
                    return True
        return False

    def solve_all(self) -> None:
        """The same by the batch solver, in the time that the whole graph takes."""
        self._catch_up()
        self.batches += 1
        optimize(self.graph, self._p)
        self.start_over()

    def start_over(self) -> None:
        """The estimate was changed by others."""
        self._at_rest, self._ahead = False, None
        self._incremental.start_over()

    def joint(self, poses: ArrayLike, landmarks: ArrayLike = ()) -> Array:
        """Joint covariance (3k + 2l, 3k + 2l) of the poses (k,), then the landmarks (l,).

        As that of Marginals. For robust weights count, it is that at the optimum; but the estimate
        stays where it is: until the next solve if that has to be found first.
        """
        if not (self._at_rest and self._incremental.is_current):
            self._solve_aside()
        return self._incremental.joint(poses, landmarks)

    def _solve_aside(self) -> None:
        """Find the optimum, but show it only with the next solve."""
        graph = self.graph
        shown = graph.poses.copy(), graph.landmarks.copy()
        try:
            self.solve()
            if not self._at_rest:  # the batch solver left no tree
                self._step()
            self._ahead = graph.poses.copy(), graph.landmarks.copy()
        except SolverError:
            self.start_over()
            raise
        finally:
            graph.poses[:], graph.landmarks[:] = shown

    def keep(
        self,
        poses: NDArray[np.bool_],
        landmarks: NDArray[np.bool_],
        disabled: NDArray[np.bool_] | None = None,
    ) -> Renumbering:
        """Graph.keep; what goes should have no enabled factor any more.

        The others stay where they are until the next solve.
        """
        graph = self.graph
        shown = graph.poses.copy(), graph.landmarks.copy()
        self._catch_up()
        try:
            self._step()
        except SolverError:
            graph.poses[:], graph.landmarks[:] = shown
            self.start_over()
            return graph.keep(poses, landmarks, disabled)
        ahead = graph.poses[poses], graph.landmarks[landmarks]
        graph.poses[:], graph.landmarks[:] = shown
        new = graph.keep(poses, landmarks, disabled)
        self._incremental.renumber(new)
        self._ahead = ahead
        return new

    def _step(self) -> None:
        self.steps += 1
        self._at_rest = False
        self._incremental.update()
