# SPDX-License-Identifier: Apache-2.0
"""Least squares over a graph: minimise the sum of rho(e^T I e) by Levenberg-Marquardt."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from rlml_slam import params
from rlml_slam.errors import SolverError
from rlml_slam.graph.graph import Graph
from rlml_slam.graph.initialize import initialize
from rlml_slam.graph.normal_equations import (
    Unknowns,
    check_finite,
    normal_equations,
    unknowns,
)
from rlml_slam.se2 import Array, wrap


@dataclass(frozen=True)
class Solution:
    """What a solve did; the estimate itself is written back into the graph.

    ``chi2`` is the sum of e^T I e over the enabled factors, ``cost`` that of the robust losses
    (what is minimised). ``iterations`` counts the linear systems solved.
    """

    chi2_initial: float
    chi2_final: float
    cost_initial: float
    cost_final: float
    iterations: int
    converged: bool
    wall_ms: float


def optimize(graph: Graph, parameters: params.Solver | None = None) -> Solution:
    """Move the free nodes of ``graph`` to the nearest minimum of the cost.

    Nodes that no enabled factor touches stay. Raises SolverError if a value is not finite, a
    part of the graph is not tied to the map or the normal equations are singular.
    """
    start = time.perf_counter()
    parameters = parameters or params.Solver()
    check_finite(graph)
    columns = unknowns(graph)
    first = normal_equations(graph, columns)
    initialize(graph, parameters.initialization)
    now = normal_equations(graph, columns)
    damping, iterations, converged = 0.0, 0, columns.size == 0
    while not converged and iterations < parameters.max_iterations:
        step = _solve(now.H, now.g, damping)
        iterations += 1
        before = graph.poses.copy(), graph.landmarks.copy()
        _apply(graph, columns, step)
        new = normal_equations(graph, columns)
        if new.cost <= now.cost * (1.0 + 1e-12) and np.isfinite(new.cost):
            converged = damping == 0.0 and (
                now.cost - new.cost <= parameters.relative_tolerance * now.cost
            )
            now, damping = new, 0.0 if damping < 1e-6 else damping / 10.0
        else:
            graph.poses[:], graph.landmarks[:] = before
            damping = max(1e-4, damping * 10.0)
            converged = damping > 1e8
    return Solution(
        first.chi2, now.chi2, first.cost, now.cost, iterations, converged,
        (time.perf_counter() - start) * 1e3,
    )  # fmt: skip


def _solve(H: sparse.csc_matrix, g: Array, damping: float) -> Array:
    damped = H + sparse.diags_array(damping * H.diagonal()) if damping else H
    try:
        factor = splu(damped.tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                      options={'SymmetricMode': True})  # fmt: skip
    except RuntimeError as error:
        raise SolverError(f'normal equations cannot be solved: {error}') from None
    return np.asarray(factor.solve(-g))


def _apply(graph: Graph, columns: Unknowns, step: Array) -> None:
    free = columns.poses >= 0
    graph.poses[free] += step[columns.poses[free, None] + np.arange(3)]
    graph.poses[:, 2] = wrap(graph.poses[:, 2])
    free = columns.landmarks >= 0
    graph.landmarks[free] += step[columns.landmarks[free, None] + np.arange(2)]
