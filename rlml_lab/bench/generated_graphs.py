# SPDX-License-Identifier: Apache-2.0
"""Generated graphs for ``rlml-lab bench``: a city of crossing streets, a hall with reflectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

# standard deviations of an edge (m, m, rad) and of a sighting per axis (m)
EDGE_SIGMA = np.array([0.03, 0.03, 0.01])
SIGHTING_SIGMA = 0.05
# those of edges that hardly know their heading
POOR_SIGMA = np.array([0.05, 0.05, 0.3])


def city(
    poses: int = 10_000, closures: float = 1.07, seed: int = 0, sigma: Array = EDGE_SIGMA
) -> Graph:
    """A drive through a grid of streets; a closure to earlier visits of the same crossing.

    ``closures`` per pose on average, edges with the standard deviations ``sigma`` (m, m, rad). The
    start is the odometry. The streets are those of the seed, whatever the sigma.
    """
    rng = np.random.default_rng(seed)
    truth = _streets(poses, rng)
    visits: dict[tuple[int, int], list[int]] = {}
    pairs = [(i, i + 1) for i in range(poses - 1)]
    for i, pose in enumerate(truth):
        cell = (round(pose[0]), round(pose[1]))
        earlier = [k for k in visits.get(cell, []) if k < i - 10]
        num = min(len(earlier), rng.poisson(1.2 * closures))
        pairs += [(int(k), i) for k in rng.choice(earlier, num, replace=False)] if num else []
        visits.setdefault(cell, []).append(i)
    return _with_edges(truth, np.array(pairs), rng, sigma)


def _streets(poses: int, rng: np.random.Generator) -> Array:
    """Poses 1 m apart on a grid, turning at random at every third crossing, within a square."""
    half = 0.35 * np.sqrt(poses)
    out = np.zeros((poses, 3))
    x, heading = np.zeros(2), 0
    for i in range(poses):
        out[i] = [*x, heading * np.pi / 2.0]
        if i % 3 == 0:
            turns = [t for t in (0, 1, -1) if np.abs(x + 3 * _ahead(heading + t)).max() <= half]
            heading += turns[rng.integers(len(turns))] if turns else 2
        x = x + _ahead(heading)
    out[:, 2] = se2.wrap(out[:, 2])
    return out


def _ahead(heading: int) -> Array:
    return np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][heading % 4])


def warehouse(poses: int = 1000, reflectors: int = 150, seed: int = 0) -> Graph:
    """Laps through a hall with reflectors seen up to 8 m; closures through reflectors alone."""
    rng = np.random.default_rng(seed)
    phi = 2.0 * np.pi * np.arange(poses) / 250.0
    radius = 20.0 + 8.0 * np.sin(0.37 * phi)
    x, y = 1.5 * radius * np.cos(phi), radius * np.sin(phi)
    truth = np.stack([x, y, np.arctan2(np.gradient(y), np.gradient(x))], -1)
    points = rng.uniform([-45.0, -30.0], [45.0, 30.0], (reflectors, 2))
    pairs = np.stack([np.arange(poses - 1), np.arange(1, poses)], -1)
    graph = _with_edges(truth, pairs, rng)
    graph.add_landmarks(points)
    for i in range(poses):
        seen = se2.transform(se2.inverse(truth[i]), points)
        for k in np.flatnonzero(np.hypot(*seen.T) < 8.0):
            z = seen[k] + SIGHTING_SIGMA * rng.standard_normal(2)
            graph.add_sighting(i, int(k), z, np.eye(2) / SIGHTING_SIGMA**2)
    initialize(graph, 'odometry')
    return graph


def _with_edges(
    truth: Array, pairs: NDArray[np.int64], rng: np.random.Generator, sigma: Array = EDGE_SIGMA
) -> Graph:
    graph = Graph()
    graph.add_poses(truth)
    graph.fixed_poses[0] = True
    i, j = pairs.T
    noise = sigma * rng.standard_normal((len(pairs), 3))
    deltas = se2.compose(se2.between(truth[i], truth[j]), noise)
    kinds = [EdgeKind.ODOMETRY if b == a + 1 else EdgeKind.CLOSURE for a, b in pairs]
    information = np.broadcast_to(np.diag(sigma**-2.0), (len(pairs), 3, 3))
    graph.add_edges(kinds, pairs, deltas, information)
    initialize(graph, 'odometry')
    return graph
