# SPDX-License-Identifier: Apache-2.0
"""Least squares over a graph: minimise the sum of rho(e^T I e) over the enabled factors."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

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
from rlml_slam.types import EdgeKind

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
    end = None
    method = parameters.initialization
    if method in ('odometry', 'spanning_tree'):
        initialize(graph, method)
    elif method == 'chordal' or (method == 'auto' and cost > BAD_START * _residuals(system)):
        end = _from_relaxation(system, poses, landmarks, parameters, cost)
    if end is None:
        end = _minimise(system, poses, landmarks, parameters)
    return Solution(
        chi2, end.chi2, cost, end.cost, end.iterations, end.converged, _since(start)
    )  # fmt: skip


def _since(start: float) -> float:
    return (time.perf_counter() - start) * 1e3


def _residuals(system: System) -> int:
    """Number of scalar residuals, the expected chi2 of a good start."""
    return 3 * len(system.edges) + 2 * len(system.sightings) + 3 * len(system.priors)


def _from_relaxation(
    system: System, poses: Array, landmarks: Array, parameters: params.Solver, cost: float
) -> Progress | None:
    """Minimise from relaxed headings; None, with the estimate as it was, if that is no better."""
    before = poses.copy(), landmarks.copy()
    if relax(system, poses, landmarks):
        end = _minimise(system, poses, landmarks, parameters)
        if end.cost < cost:
            return end
    poses[:], landmarks[:] = before
    return None


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


def warm_up() -> None:
    """Compile every kernel of the solver."""
    graph = Graph()
    graph.add_poses([[k, 0.0, 0.0] for k in range(3)])
    graph.fixed_poses[0] = True
    graph.add_landmark([1.0, 1.0])
    graph.add_edges(EdgeKind.ODOMETRY, [[0, 1], [1, 2]], [[1.0, 0.1, 0.0]] * 2, [np.eye(3)] * 2)
    graph.add_sightings([[0, 0], [2, 0]], [[1.0, 1.0], [-1.0, 1.1]], [np.eye(2)] * 2)
    for method in ('auto', 'dog_leg'):
        optimize(graph, params.Solver(initialization='chordal', method=method))
