# SPDX-License-Identifier: Apache-2.0
"""Least squares over a graph: minimise the sum of rho(e^T I e) over the enabled factors."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rlml_slam import params
from rlml_slam.graph.chordal import relax
from rlml_slam.graph.descend import dog_leg, levenberg_marquardt
from rlml_slam.graph.equations import system_of
from rlml_slam.graph.graph import Graph
from rlml_slam.graph.initialize import initialize
from rlml_slam.graph.iterate import Progress, gauss_newton
from rlml_slam.graph.linearize import linearize
from rlml_slam.graph.system import System
from rlml_slam.se2 import Array

# a start is bad, and one is computed from the edges, above this cost per residual
BAD_START = 4.0
# costs below this per residual are rounding
NOTHING = 1e-18


@dataclass(frozen=True)
class Solution:
    """What a solve did; the estimate itself is written back into the graph.

    ``chi2`` is the sum of e^T I e over the enabled factors, ``cost`` that of the robust losses
    (what is minimised). ``iterations`` counts the steps tried.
    """

    chi2_initial: float
    chi2_final: float
    cost_initial: float
    cost_final: float
    iterations: int
    converged: bool
    wall_ms: float


def optimize(graph: Graph, parameters: params.Solver | None = None) -> Solution:
    """Move the free nodes of ``graph`` to a minimum of the cost.

    Nodes that no enabled factor touches stay. Raises SolverError if a value is not finite or a
    part of the graph is not tied to the map.
    """
    start = time.perf_counter()
    parameters = parameters or params.Solver()
    system = system_of(graph)
    poses, landmarks = graph.poses, graph.landmarks
    cost, chi2 = linearize(system, poses, landmarks, False)
    if not len(system.variables):
        return Solution(chi2, chi2, cost, cost, 0, True, _since(start))
    if parameters.initialization == 'auto':
        if cost > BAD_START * _residuals(system):
            _relax_if_better(system, poses, landmarks, cost)
    elif parameters.initialization == 'chordal':
        relax(system, poses, landmarks)
    else:
        initialize(graph, parameters.initialization)
    end = _minimise(system, poses, landmarks, parameters)
    return Solution(
        chi2, end.chi2, cost, end.cost, end.iterations, end.converged, _since(start)
    )  # fmt: skip


def _since(start: float) -> float:
    return (time.perf_counter() - start) * 1e3


def _residuals(system: System) -> int:
    """Number of scalar residuals, the expected chi2 of a good start."""
    return 3 * len(system.edges) + 2 * len(system.sightings) + 3 * len(system.priors)


def _relax_if_better(system: System, poses: Array, landmarks: Array, cost: float) -> None:
    before = poses.copy(), landmarks.copy()
    relax(system, poses, landmarks)
    if not linearize(system, poses, landmarks, False)[0] < cost:
        poses[:], landmarks[:] = before


def _minimise(
    system: System, poses: Array, landmarks: Array, parameters: params.Solver
) -> Progress:
    limit, tolerance = parameters.max_iterations, parameters.relative_tolerance
    floor = NOTHING * _residuals(system)
    if parameters.method == 'levenberg_marquardt':
        return levenberg_marquardt(system, poses, landmarks, limit, tolerance, floor)
    if parameters.method == 'dog_leg':
        return dog_leg(system, poses, landmarks, limit, tolerance, floor)
    end = gauss_newton(system, poses, landmarks, limit, tolerance, floor)
    if end.converged or parameters.method == 'gauss_newton':
        return end
    more = dog_leg(system, poses, landmarks, limit, tolerance, floor)
    return more._replace(iterations=end.iterations + more.iterations)
