# SPDX-License-Identifier: Apache-2.0
"""GTSAM's robust solvers for ``rlml bench robust``: GNC, and Levenberg-Marquardt with kernels."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.graph import Graph
from rlml_slam.graph.table import FactorKind
from rlml_slam.tools.bench_rivals import timed

PROBABILITY = 0.99  # of an inlier to be inside GNC's truncation
ITERATIONS = 200


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


def _write(graph: Graph, result: Any) -> None:
    for i in range(len(graph.poses)):
        T = result.atPose2(i)
        graph.poses[i] = [T.x(), T.y(), T.theta()]


def run_gnc(graph: Graph) -> tuple[float, NDArray[np.bool_]]:
    """(CPU time [ms], closures accepted (k,)): truncated least squares, odometry known."""
    factors, values = _problem(graph)
    closures = np.flatnonzero(graph.edges.kinds == FactorKind.CLOSURE)
    known = np.flatnonzero(graph.edges.kinds != FactorKind.CLOSURE).tolist()
    options = gtsam.GncLMParams()
    options.setLossType(gtsam.GncLossType.TLS)
    options.setKnownInliers([*known, len(graph.edges)])
    optimizer = gtsam.GncLMOptimizer(factors, values, options)
    optimizer.setInlierCostThresholdsAtProbability(PROBABILITY)
    ms, result = timed(optimizer.optimize)
    _write(graph, result)
    return ms, np.asarray(optimizer.getWeights())[closures] >= 0.5


def run_kernel(graph: Graph, name: str, scale: float) -> float:
    """CPU time [ms] of Levenberg-Marquardt with the M-estimator ``name`` on the closures."""
    factors, values = _problem(graph, getattr(gtsam.noiseModel.mEstimator, name).Create(scale))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(ITERATIONS)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, options)
    ms, result = timed(optimizer.optimize)
    _write(graph, result)
    return ms
