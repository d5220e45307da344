# SPDX-License-Identifier: Apache-2.0
"""Batch solver: minimise the sum of rho(e^T I e) over the enabled factors of a graph."""

from __future__ import annotations

import math
import threading
import time
from typing import NamedTuple

import numpy as np

from rlml_slam import params
from rlml_slam.compiled import kernel, part
from rlml_slam.graph.batch import landmark_start
from rlml_slam.graph.batch.chordal_relaxation import relax
from rlml_slam.graph.batch.gauss_newton import Progress, copy, gauss_newton
from rlml_slam.graph.batch.second_start import restart
from rlml_slam.graph.batch.trust_region import dog_leg
from rlml_slam.graph.model.buffers import nodes_at, tables_at
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.linearization import linearize
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.graph.model.packed_system import System, pack_system
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

# A start is bad, and one is computed from the edges, above this cost per residual: three sigmas in
# the root mean square. Below, it might be noise, and Gauss-Newton converges sooner.
BAD_START = 9.0
# Gauss-Newton steps from relaxed headings, after which another start is tried
MAX_RELAXED_STEPS = 12
# costs below this per residual are rounding: (1e-9 sigma)^2
ROUNDING = 1e-18


class _Workspace(threading.local):
    """Memory of a thread's solves, kept for the next one.

    Allocating it again from the operating system, a page at a time, would cost as much as a
    factorization of a small graph.
    """

    def __init__(self) -> None:
        self.memory = np.empty(0)


_WORKSPACE = _Workspace()
DEFAULT = params.Solver()
# when headings are relaxed first
NEVER, IF_BAD, ALWAYS = 0, 1, 2


class Solution(NamedTuple):
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


def optimize(graph: Graph, parameters: params.Solver = DEFAULT) -> Solution:
    """Move the free nodes of ``graph`` to a minimum of the cost.

    Nodes that no enabled factor touches stay. Raises SolverError if a value is not finite or a
    part of the graph is not anchored to the map.
    """
    began = time.perf_counter()
    p = parameters
    relaxing = {'auto': IF_BAD, 'chordal': ALWAYS, 'none': NEVER}[p.initialization]
    memory = _WORKSPACE.memory
    used, start, end = _gauss_newton(
        graph.addresses().at, graph.losses.codes, memory, relaxing, p.max_iterations,
        p.relative_tolerance,
    )  # fmt: skip
    if used < 0:
        build_system(graph)  # raises, and names the node
    elif used > len(memory):
        _WORKSPACE.memory = np.empty(used + used // 4)
    if not end.converged and relaxing != NEVER:
        end = _restart(graph, start, end, p, relaxing)
    if not end.converged:
        more = _minimize_by_trust_region(graph, start, p)
        end = more._replace(iterations=end.iterations + more.iterations)
    return Solution(
        start.chi2, end.chi2, start.cost, end.cost, end.iterations, end.converged,
        (time.perf_counter() - began) * 1e3,
    )  # fmt: skip


def _restart(
    graph: Graph, start: Progress, end: Progress, p: params.Solver, relaxing: int
) -> Progress:
    """Another start, where Gauss-Newton from relaxed headings did not converge."""
    system = build_system(graph)
    num = num_residuals(system)
    if relaxing != ALWAYS and not start.cost > BAD_START * num:
        return end
    limits = p.max_iterations, p.relative_tolerance, ROUNDING * num
    more = restart(system, graph.poses, graph.landmarks, *limits)
    return more._replace(iterations=end.iterations + more.iterations)


def _minimize_by_trust_region(graph: Graph, start: Progress, p: params.Solver) -> Progress:
    """Minimise by a method that never raises the cost, also where H is singular."""
    system = build_system(graph)
    if not len(system.variables):
        return start._replace(converged=True)
    limits = p.max_iterations, p.relative_tolerance, ROUNDING * num_residuals(system)
    return dog_leg(system, graph.poses, graph.landmarks, *limits)


@kernel
def _gauss_newton(
    addresses: Ints, losses: Array, memory: Array, relaxing: int, max_iterations: int,
    tolerance: float,
) -> tuple[int, Progress, Progress]:  # fmt: skip
    """(memory used or -1 if the graph cannot be solved, start, end) of Gauss-Newton.

    The graph has its buffers at ``addresses``. One call: passing arrays in and out of several
    costs as much as the optimization of a small graph.
    """
    poses, landmarks = nodes_at(addresses)
    nothing = Progress(math.nan, math.nan, 0, False)
    if not (finite(poses) and finite(landmarks)):
        return -1, nothing, nothing
    unanchored, system = pack_system(tables_at(addresses, losses), memory)
    if unanchored >= 0:
        return -1, nothing, nothing
    start, end = _minimize(system, poses, landmarks, relaxing, max_iterations, tolerance)
    return len(system.values) + len(system.left) + len(system.right), start, end


@part
def _minimize(
    system: System, poses: Array, landmarks: Array, relaxing: int, max_iterations: int,
    tolerance: float,
) -> tuple[Progress, Progress]:  # fmt: skip
    """(Start, end); relaxed headings that lead to no lower cost are undone."""
    num = num_residuals(system)
    floor = ROUNDING * num
    cost, chi2 = linearize(system, poses, landmarks, True)
    start = Progress(cost, chi2, 0, len(system.variables) == 0)
    if start.converged:
        return start, start
    if relaxing == ALWAYS or (relaxing == IF_BAD and cost > BAD_START * num):
        kept, kept_landmarks = poses.copy(), landmarks.copy()
        if relax(system, poses, landmarks):
            at = linearize(system, poses, landmarks, True)
            end = gauss_newton(
                system, poses, landmarks, at[0], at[1], min(MAX_RELAXED_STEPS, max_iterations),
                tolerance, floor,
            )  # fmt: skip
            if end.cost < cost:
                return start, end
        copy(kept, poses)
        copy(kept_landmarks, landmarks)
        linearize(system, poses, landmarks, True)
    end = gauss_newton(system, poses, landmarks, cost, chi2, max_iterations, tolerance, floor)
    return start, end


@kernel
def num_residuals(system: System) -> int:
    """Number of scalar residuals, the expected chi2 at the optimum; a range counts two."""
    return 3 * len(system.edges) + 2 * len(system.sightings) + 3 * len(system.priors)


@part
def finite(values: Array) -> bool:
    """Whether all values are finite."""
    total = 0.0  # not a number as soon as a value is not finite: no branch in the loop
    for i in range(len(values)):
        for k in range(values.shape[1]):
            total += values[i, k] - values[i, k]
    return total == 0.0


def warm_up() -> None:
    """Compile every kernel of the solver."""
    graph = Graph()
    graph.add_poses([[k, 0.0, 0.0] for k in range(3)])
    graph.fixed_poses[0] = True
    graph.add_landmark([1.0, 1.0])
    graph.add_edges(EdgeKind.ODOMETRY, [[0, 1], [1, 2]], [[1.0, 0.1, 0.0]] * 2, [np.eye(3)] * 2)
    graph.add_sightings([[0, 0], [2, 0]], [[1.0, 1.0], [-1.0, 1.1]], [np.eye(2)] * 2)
    landmark_start.warm_up()
    optimize(graph, params.Solver(initialization='chordal'))
    _minimize_by_trust_region(graph, Progress(math.inf, math.inf, 0, False), DEFAULT)
    restart(build_system(graph), graph.poses, graph.landmarks, 1, 0.0, 0.0)
