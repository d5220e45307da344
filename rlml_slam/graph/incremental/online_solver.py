# SPDX-License-Identifier: Apache-2.0
"""Online solver: keeps the estimate of a growing graph at the optimum.

A keyframe usually takes one or a few steps of the incremental solver, whose cost depends on what
has changed alone. Where that does not converge, or the start is bad, the batch solver takes over,
which computes another start and never ends at a higher cost.
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

# Incremental steps before the cost of the whole graph is evaluated, and in all: then the batch
# solver takes over, which needs fewer iterations from a good start.
UNCHECKED_STEPS, MAX_STEPS = 5, 40
# Relative decrease of the cost at which the steps end. Robust weights may converge slowly: where
# each step gains 0.9 of what the last one did, this leaves 0.01 % of the cost, for the next solve.
MIN_DECREASE = 1e-5


class OnlineSolver:
    """Estimate and covariances of ``graph``; ``steps`` incremental, ``batches`` batch solves.

    Whoever changes the estimate in the graph has to call ``start_over``.
    """

    def __init__(self, graph: Graph, parameters: params.Solver = DEFAULT) -> None:
        self.graph = graph
        self.steps = self.batches = 0
        self._p = parameters
        self._incremental = IncrementalSolver(graph)
        self._converged = False  # the last solve ended, and no step came since
        # the estimate of the solver, where the graph shows an older one until the next solve
        self._ahead: tuple[Array, Array] | None = None

    def solve(self) -> None:
        """Bring the estimate to the optimum; raises SolverError as the solvers do."""
        self._write_back()
        if self._converged and self._incremental.is_current:
            return
        graph = self.graph
        before = graph.poses.copy(), graph.landmarks.copy()
        try:
            self._converged = self._step_to_optimum(before)
        except SolverError:
            self._converged = False  # where the graph itself is at fault, the batch solver raises
        if not self._converged:
            graph.poses[:], graph.landmarks[:] = before
            self.solve_all()

    def _write_back(self) -> None:
        """Write what was solved for the covariances alone into the graph."""
        if self._ahead is not None:
            poses, landmarks = self._ahead
            self.graph.poses[: len(poses)] = poses
            self.graph.landmarks[: len(landmarks)] = landmarks
            self._ahead = None

    def _step_to_optimum(self, before: tuple[Array, Array]) -> bool:
        """Incremental steps until they converge; False where they do not."""
        graph = self.graph
        self._step()
        if self._incremental.settled:
            return True  # linear models that still hold: the cost is where they say
        start, num = total_cost(graph.tables(), *before)
        cost, steps = start, 1
        while start <= BAD_START * num and steps < MAX_STEPS and cost <= start:
            self._step()
            steps += 1
            if self._incremental.settled:
                return True
            if steps >= UNCHECKED_STEPS:
                last, cost = cost, total_cost(graph.tables(), graph.poses, graph.landmarks)[0]
                if abs(last - cost) <= MIN_DECREASE * cost:
                    return True
        return False

    def solve_all(self) -> None:
        """As ``solve``, by the batch solver, in the time that the whole graph takes."""
        self._write_back()
        self.batches += 1
        optimize(self.graph, self._p)
        self.start_over()

    def start_over(self) -> None:
        """Start from the estimate in the graph: it was changed from outside."""
        self._converged, self._ahead = False, None
        self._incremental.start_over()

    def joint(self, poses: ArrayLike, landmarks: ArrayLike = ()) -> Array:
        """Joint covariance (3k + 2l, 3k + 2l) of the poses (k,), then the landmarks (l,).

        As that of Marginals, at the optimum, as robust weights count. Where the optimum has to be
        found first, the graph shows it from the next solve on.
        """
        if not (self._converged and self._incremental.is_current):
            self._solve_hidden()
        return self._incremental.joint(poses, landmarks)

    def _solve_hidden(self) -> None:
        """Find the optimum, but write it into the graph only with the next solve."""
        graph = self.graph
        shown = graph.poses.copy(), graph.landmarks.copy()
        try:
            self.solve()
            if not self._converged:  # the batch solver left no tree
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
        """Graph.keep; what is removed should have no enabled factor any more.

        The estimate of the others does not change until the next solve.
        """
        graph = self.graph
        shown = graph.poses.copy(), graph.landmarks.copy()
        self._write_back()
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
        self._converged = False
        self._incremental.update()
