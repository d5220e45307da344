# SPDX-License-Identifier: Apache-2.0
"""Graduated non-convexity: truncated least squares over the closures, from a convex cost on.

With s = e^T I e, c the truncation and mu the convexity, the weights in closed form are (Yang,
Antonante, Tzoumas & Carlone, RA-L 5 (2020); eq. 43)

    w = 1                               s <= mu / (mu + 1) c^2
        c / sqrt(s) sqrt(mu (mu + 1)) - mu    between
        0                               s >= (mu + 1) / mu c^2.

Every round starts from the initial estimate: from that of the last round, bent by wrong closures
that still had weight, Gauss-Newton may not reach the minimum.

It needs no trusted odometry, but converges to whatever all closures together bend the map into:
closure_selection.py does better wherever there is odometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params
from rlml_slam.graph.batch.gauss_newton import gauss_newton
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.solver import ROUNDING, optimize
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.linearization import linearize
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.graph.model.robust_loss import Loss
from rlml_slam.se2 import Array

SCALE = 3.368  # truncation in sigmas: 99 % of a chi-square with 3 degrees of freedom
FACTOR = 1.4  # of mu per round, of the paper
ROUNDS = 100
NEARLY = 1e-3  # weights this near to 0 or 1 are there
ROUGHLY = 1e-5  # relative tolerance of a round: only the last estimate has to be exact
LEAST = 1e-9  # weight of a closure that counts nothing, which keeps the graph in one piece
INFORMATION = ('I00', 'I01', 'I02', 'I11', 'I12', 'I22')


@dataclass(frozen=True)
class Graduated:
    """``edges`` (k,) are the closures, ``weights`` (k,) between 0 and 1; ``rounds`` of mu."""

    edges: NDArray[np.int64]
    weights: Array
    rounds: int


def truncated_weights(s: Array, scale: float, mu: float) -> Array:
    """Weights (k,) of squared norms s (k,) at convexity mu."""
    c2 = scale * scale
    low = mu / (mu + 1.0) * c2
    between = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(s, low)) - mu
    return np.asarray(np.clip(between, 0.0, 1.0))


def graduate(
    graph: Graph, parameters: params.Solver | None = None, scale: float = SCALE
) -> Graduated:
    """Weigh the enabled closures and disable those that end below 1/2; the optimum is left.

    Raises SolverError like ``optimize``.
    """
    parameters = parameters or params.Solver()
    losses, e = graph.losses, graph.edges
    graph.losses = replace(losses, closure=Loss())
    try:
        if parameters.initialization not in ('none', 'auto'):
            initialize(graph, parameters.initialization)
        edges = np.flatnonzero(e.enabled & (e.kinds == FactorKind.CLOSURE))
        weights, rounds = _anneal(graph, parameters, edges, scale)
        e.enabled[edges[weights < 0.5]] = False
        optimize(graph, parameters)
    finally:
        graph.losses = losses
    return Graduated(edges, weights, rounds)


def _anneal(
    graph: Graph, parameters: params.Solver, edges: NDArray[np.int64], scale: float
) -> tuple[Array, int]:
    start = graph.poses.copy(), graph.landmarks.copy()
    system = build_system(graph)
    row = np.searchsorted(np.flatnonzero(graph.edges.enabled), edges)
    full = {name: system.edges[name][row].copy() for name in INFORMATION}
    weights, mu = np.ones(len(edges)), 0.0
    floor = ROUNDING * 3.0 * len(system.edges)
    for rounds in range(1, ROUNDS + 1):
        for name in INFORMATION:
            system.edges[name][row] = np.maximum(weights, LEAST) * full[name]
        graph.poses[:], graph.landmarks[:] = start
        cost, chi2 = linearize(system, graph.poses, graph.landmarks, True)
        gauss_newton(
            system, graph.poses, graph.landmarks, cost, chi2, parameters.max_iterations,
            max(parameters.relative_tolerance, ROUGHLY), floor,
        )  # fmt: skip
        s = graph.residuals().edges[edges]
        worst = float(s.max(initial=0.0))
        if rounds == 1:
            if worst <= scale * scale:
                break
            mu = scale * scale / (2.0 * worst - scale * scale)
        weights = truncated_weights(s, scale, mu)
        if rounds > 1 and (np.abs(weights - np.round(weights)) < NEARLY).all():
            break
        mu *= FACTOR
    return weights, rounds
