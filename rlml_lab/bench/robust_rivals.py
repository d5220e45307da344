# SPDX-License-Identifier: Apache-2.0
"""GTSAM's robust solvers for ``rlml-lab bench robust``: GNC, and Levenberg-Marquardt with kernels.

They run in a process of their own, which the system ends where a solve takes more CPU time than
it may: a call into GTSAM cannot be interrupted otherwise.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from rlml_lab.bench.rivals import timed
from rlml_lab.bench.robust_cases import Outcome
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array

PROBABILITY = 0.99  # of an inlier to be inside GNC's truncation
ITERATIONS = 200

# CPU time [ms], poses (n, 3), closures accepted (k,) or None
Solved = tuple[float, Array, NDArray[np.bool_] | None]


class Rivals:
    """Runs the functions of this module with ``limit`` [s] of CPU time each."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._pool: ProcessPoolExecutor | None = None

    def run(self, solve: Callable[..., Solved], graph: Graph, *rest: Any) -> Outcome:
        """Solve, and write the poses into the graph if that comes to an end."""
        if self._pool is None:
            context = multiprocessing.get_context('spawn')
            self._pool = ProcessPoolExecutor(1, mp_context=context)
        try:
            done = self._pool.submit(_limited, self._limit, solve, graph, *rest).result()
        except BrokenProcessPool:
            self.close()
            return Outcome(self._limit * 1e3, stopped=f'over {self._limit:g} s')
        if isinstance(done, Outcome):
            return done
        graph.poses[:] = done[1]
        return Outcome(done[0], done[2])

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _limited(limit: float, solve: Callable[..., Solved], *rest: Any) -> Solved | Outcome:
    """Call, in a process that ends if this takes more CPU time than ``limit`` [s]."""
    start = time.process_time()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(start + limit), most))
    try:
        return solve(*rest)
    except RuntimeError as e:  # GTSAM's, of equations that it cannot solve
        words = str(e).strip().partition('\n')[0]
        return Outcome((time.process_time() - start) * 1e3, stopped=words)


def _problem(graph: Graph, kernel: Any = None) -> tuple[Any, Any]:
    """Factors, in the order of the edges and then a prior, and values."""
    values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for i, pose in enumerate(graph.poses):
        values.insert(i, gtsam.Pose2(*pose))
    e = graph.edges
    for (i, j), z, info, kind in zip(e.nodes, e.measured, e.information, e.kinds, strict=True):
        noise: Any = gtsam.noiseModel.Gaussian.Information(info)
        if kernel is not None and kind == FactorKind.CLOSURE:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
    fixed = int(np.flatnonzero(graph.fixed_poses)[0])
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    factors.add(gtsam.PriorFactorPose2(fixed, gtsam.Pose2(*graph.poses[fixed]), tight))
    return factors, values


def _poses(n: int, result: Any) -> Array:
    T = [result.atPose2(i) for i in range(n)]
    return np.array([[one.x(), one.y(), one.theta()] for one in T])


def run_gnc(graph: Graph) -> Solved:
    """Truncated least squares, odometry known."""
    factors, values = _problem(graph)
    closures = np.flatnonzero(graph.edges.kinds == FactorKind.CLOSURE)
    known = np.flatnonzero(graph.edges.kinds != FactorKind.CLOSURE).tolist()
    options = gtsam.GncLMParams()
    options.setLossType(gtsam.GncLossType.TLS)
    options.setKnownInliers([*known, len(graph.edges)])
    optimizer = gtsam.GncLMOptimizer(factors, values, options)
    optimizer.setInlierCostThresholdsAtProbability(PROBABILITY)
    ms, result = timed(optimizer.optimize)
    accepted = np.asarray(optimizer.getWeights())[closures] >= 0.5
    return ms, _poses(len(graph.poses), result), accepted


def run_kernel(graph: Graph, name: str, scale: float) -> Solved:
    """Levenberg-Marquardt with the M-estimator ``name`` on the closures."""
    factors, values = _problem(graph, getattr(gtsam.noiseModel.mEstimator, name).Create(scale))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(ITERATIONS)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, options)
    ms, result = timed(optimizer.optimize)
    return ms, _poses(len(graph.poses), result), None
