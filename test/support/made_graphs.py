# SPDX-License-Identifier: Apache-2.0
"""Small made-up graphs for the tests of graph/, and the place of the shared data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rlml_slam import params, se2
from rlml_slam.graph.batch.solver import ROUNDING, num_residuals, optimize
from rlml_slam.graph.batch.trust_region import dog_leg
from rlml_slam.graph.model.factors import Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.types import EdgeKind

SHARED_GRAPHS = Path(__file__).resolve().parents[2].parent / 'shared' / 'data' / 'graphs-2d'


def shared_graph(name: str) -> Path:
    path = SHARED_GRAPHS / name
    if not path.exists():
        pytest.skip(f'needs the shared data set {name} in {SHARED_GRAPHS}')
    return path


def chi2_by_gauss_newton(graph: Graph, limits: params.Solver) -> float:
    return optimize(graph, limits).chi2_final


def chi2_by_dog_leg(graph: Graph, limits: params.Solver) -> float:
    """By the method that ``optimize`` goes on with where Gauss-Newton does not converge."""
    system = build_system(graph)
    floor = ROUNDING * num_residuals(system)
    args = limits.max_iterations, limits.relative_tolerance, floor
    return dog_leg(system, graph.poses, graph.landmarks, *args).chi2


METHODS = (chi2_by_gauss_newton, chi2_by_dog_leg)


def loop_graph(
    seed: int = 0,
    poses: int = 30,
    landmarks: int = 8,
    noise: float = 1.0,
    start_noise: float = 0.0,
    losses: Losses | None = None,
) -> tuple[Graph, np.ndarray, np.ndarray]:
    """A robot on two laps of a circle that sees landmarks within 6 m: (graph, truth, truth).

    ``noise`` scales the measurement noise; the information always matches noise = 1.
    """
    rng = np.random.default_rng(seed)
    phi = 4.0 * np.pi * np.arange(poses) / poses
    truth = np.stack([5 * np.cos(phi), 5 * np.sin(phi), se2.wrap(phi + np.pi / 2)], -1)
    points = rng.uniform(-8.0, 8.0, (landmarks, 2))
    sigma = np.array([0.05, 0.05, 0.02])
    graph = Graph(losses)
    start = truth + start_noise * rng.standard_normal(truth.shape) * [0.1, 0.1, 0.05]
    start[0] = truth[0]
    graph.add_poses(start)
    graph.fixed_poses[0] = True
    graph.add_landmarks(points + start_noise * 0.1 * rng.standard_normal(points.shape))
    pairs = [(i, i + 1) for i in range(poses - 1)]
    pairs += [(i, i + poses // 2) for i in range(0, poses - poses // 2, 4)]
    for i, j in pairs:
        e = noise * sigma * rng.standard_normal(3)
        delta = se2.compose(se2.between(truth[i], truth[j]), e)
        kind = EdgeKind.ODOMETRY if j == i + 1 else EdgeKind.CLOSURE
        graph.add_edge(kind, i, j, delta, np.diag(sigma**-2))
    for i in range(poses):
        seen = se2.transform(se2.inverse(truth[i]), points)
        for k in np.flatnonzero(np.hypot(*seen.T) < 6.0):
            z = seen[k] + noise * 0.03 * rng.standard_normal(2)
            graph.add_sighting(i, int(k), z, np.eye(2) / 0.03**2)
    return graph, truth, points


def range_graph(
    seed: int = 0,
    poses: int = 30,
    beacons: int = 2,
    noise: float = 1.0,
    start_noise: float = 0.0,
    losses: Losses | None = None,
) -> tuple[Graph, np.ndarray, np.ndarray]:
    """A robot on two laps of an ellipse that hears beacons at a range: (graph, truth, truth)."""
    rng = np.random.default_rng(seed)
    phi = 4.0 * np.pi * np.arange(poses) / poses
    truth = np.stack([5 * np.cos(phi), 3 * np.sin(phi), se2.wrap(phi + np.pi / 2)], -1)
    points = np.array([[2.0, 1.0], [-6.0, 4.0], [7.0, -3.0], [0.0, -8.0]])[:beacons]
    sigma, sigma_range = np.array([0.05, 0.05, 0.02]), 0.1
    graph = Graph(losses)
    start = truth + start_noise * rng.standard_normal(truth.shape) * [0.1, 0.1, 0.05]
    start[0] = truth[0]
    graph.add_poses(start)
    graph.fixed_poses[0] = True
    graph.add_landmarks(points + start_noise * 0.2 * rng.standard_normal(points.shape))
    for i in range(poses - 1):
        e = noise * sigma * rng.standard_normal(3)
        delta = se2.compose(se2.between(truth[i], truth[i + 1]), e)
        graph.add_edge(EdgeKind.ODOMETRY, i, i + 1, delta, np.diag(sigma**-2))
    for i in range(poses):
        for k in range(beacons):
            r = np.hypot(*(points[k] - truth[i, :2])) + noise * sigma_range * rng.standard_normal()
            graph.add_range(i, k, max(r, 0.0), sigma_range**-2.0)
    return graph, truth, points


# sigmas [m, rad] of the edges of laps, and wrong closures for spoil
SIGMA = np.array([0.03, 0.03, 0.01])
WRONG = [(3, 33), (10, 95), (44, 140), (70, 100), (20, 170), (21, 52), (90, 175), (5, 130)]


def laps(seed=0, laps=3, per_lap=60, turned=0.0, losses=None):
    """A robot on laps of a circle, with closures to every third pose of the lap before."""
    rng = np.random.default_rng(seed)
    phi = 2.0 * np.pi * np.arange(laps * per_lap) / per_lap
    truth = np.stack([10 * np.cos(phi), 10 * np.sin(phi), se2.wrap(phi + np.pi / 2)], -1)
    truth = se2.compose([5.0 * turned, -turned, turned], truth)
    graph = Graph(losses)
    graph.add_poses(truth)
    graph.fixed_poses[0] = True
    n = len(truth)
    pairs = [(i, i + 1) for i in range(n - 1)] + [
        (i, i + per_lap) for i in range(0, n - per_lap, 3)
    ]
    for i, j in pairs:
        kind = EdgeKind.ODOMETRY if j == i + 1 else EdgeKind.CLOSURE
        delta = se2.compose(se2.between(truth[i], truth[j]), SIGMA * rng.standard_normal(3))
        graph.add_edge(kind, i, j, delta, np.diag(SIGMA**-2))
    return graph


def spoil(graph, pairs):
    """Closures that say that two far poses are one."""
    return [
        graph.add_edge(EdgeKind.CLOSURE, i, j, np.zeros(3), np.diag(SIGMA**-2)) for i, j in pairs
    ]
