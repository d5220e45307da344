# SPDX-License-Identifier: Apache-2.0
"""Initial estimates from the factors alone: plain odometry, spanning tree, chordal relaxation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.chordal_relaxation import relax
from rlml_slam.graph.batch.landmark_start import place_landmarks
from rlml_slam.graph.model.factors import NUM_RESIDUALS
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.se2 import Array, compose, inverse

METHODS = ('none', 'odometry', 'spanning_tree', 'chordal')


def initialize(graph: Graph, method: str) -> None:
    """Overwrite the free nodes by ``method``; SolverError if there is no such method."""
    if method not in METHODS:
        raise SolverError(f'initialization {method!r} is none of {", ".join(METHODS)}')
    if method == 'chordal':
        relax(build_system(graph), graph.poses, graph.landmarks)
    elif method != 'none' and len(graph.poses):
        spanning_tree(graph, consecutive_first=method == 'odometry')


def _roots(graph: Graph) -> NDArray[np.int64]:
    roots = np.flatnonzero(graph.fixed_poses)
    p = graph.pose_priors
    whole = p.enabled & (NUM_RESIDUALS[p.kinds] == 3)
    return np.unique(np.concatenate([roots, p.nodes[whole][:, 0], [0]]))


def spanning_tree(graph: Graph, consecutive_first: bool = False) -> None:
    """Poses by breadth-first composition of edges from the fixed ones; landmarks from sightings.

    With ``consecutive_first`` an edge i to i + 1 is preferred (plain odometry).
    """
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    i, j = e.nodes[use].T
    cost = np.where(np.abs(i - j) == 1, 1.0, 1e6 if consecutive_first else 1.0)
    _compose_tree(graph, use, cost, _roots(graph))
    place_landmarks(graph)


def _compose_tree(
    graph: Graph, use: NDArray[np.int64], cost: Array, roots: NDArray[np.int64]
) -> None:
    n = len(graph.poses)
    i, j = graph.edges.nodes[use].T
    # the cheapest of parallel edges
    order = np.argsort(cost, kind='stable')[::-1]
    best = {
        (min(a, b), max(a, b)): int(k) for k, a, b in zip(order, i[order], j[order], strict=True)
    }
    keys = np.array(list(best), dtype=np.int64).reshape(-1, 2)
    chosen = np.array(list(best.values()), dtype=np.int64)
    # roots hang below an extra node n, so that one search starts from all of them
    rows = np.concatenate([keys[:, 0], np.full(len(roots), n)])
    cols = np.concatenate([keys[:, 1], roots])
    weights = np.concatenate([cost[chosen], np.full(len(roots), 1e-3)])
    links = sparse.csr_matrix((weights, (rows, cols)), (n + 1, n + 1))
    if (cost == cost[:1]).all():
        order, parent = sparse.csgraph.breadth_first_order(links, n, directed=False)
    else:
        tree = sparse.csgraph.minimum_spanning_tree(links)
        order, parent = sparse.csgraph.breadth_first_order(tree, n, directed=False)
    for b in order[1:]:
        a = int(parent[b])
        if a == n:
            continue
        k = use[best[min(a, b), max(a, b)]]
        delta = graph.edges.measured[k]
        forward = graph.edges.nodes[k, 0] == a
        graph.poses[b] = compose(graph.poses[a], delta if forward else inverse(delta))
