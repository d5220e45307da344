# SPDX-License-Identifier: Apache-2.0
"""Wrong closures for graphs that have none, as a place that is taken for another makes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

Ints = NDArray[np.int64]
# a wrong match says that two poses are at about the same place (the noise of Vertigo, Sünderhauf
# & Protzel 2012)
SIGMA = np.array([0.3, 0.3, np.radians(10.0)])
GROUP = 10  # closures of one place that was taken for another
APART = 40  # poses that lie between two places at least


def copied(graph: Graph) -> Graph:
    """The poses and edges of a graph, with closures as such."""
    out, e = Graph(), graph.edges
    out.add_poses(graph.poses)
    out.fixed_poses[:] = graph.fixed_poses
    kinds = [EdgeKind.CLOSURE if k == FactorKind.CLOSURE else EdgeKind.ODOMETRY for k in e.kinds]
    out.add_edges(kinds, e.nodes, e.measured, e.information)
    return out


def add_random(graph: Graph, count: int, rng: np.random.Generator) -> None:
    """``count`` closures between any two poses."""
    i, j = np.sort(_pairs(len(graph.poses), count, 2, rng), axis=1).T
    _add(graph, np.stack([i, j], -1), SIGMA * rng.standard_normal((count, 3)))


def add_clustered(graph: Graph, true: Array, count: int, rng: np.random.Generator) -> None:
    """``count`` closures in groups that agree: in each, one place is taken for another.

    ``true`` (n, 3) are the poses: the members of a group are consistent with one false placing of
    the second place at the first.
    """
    nodes: list[tuple[int, int]] = []
    deltas: list[Array] = []
    while len(nodes) < count:
        a, b = np.sort(_pairs(len(true), 1, APART, rng)[0])
        T_a_b = SIGMA * rng.standard_normal(3)
        for k in range(min(GROUP, count - len(nodes))):
            i, j = min(a + k, len(true) - 1), min(b + int(rng.integers(GROUP)), len(true) - 1)
            near_b = se2.compose(T_a_b, se2.between(true[b], true[j]))
            nodes.append((i, j))
            deltas.append(se2.compose(se2.between(true[i], true[a]), near_b))
    _add(graph, np.array(nodes), np.array(deltas))


def _pairs(n: int, count: int, apart: int, rng: np.random.Generator) -> Ints:
    """Pairs (count, 2) of poses at least ``apart`` from each other."""
    out = np.zeros((0, 2), dtype=np.int64)
    while len(out) < count:
        more = rng.integers(0, n, (count, 2))
        out = np.concatenate([out, more[np.abs(more[:, 0] - more[:, 1]) >= apart]])
    return out[:count]


def _add(graph: Graph, nodes: Ints, deltas: Array) -> None:
    """With the information that right closures have in the median."""
    e = graph.edges
    typical = np.median(e.information[e.kinds == FactorKind.CLOSURE], axis=0)
    graph.add_edges(EdgeKind.CLOSURE, nodes, deltas, np.broadcast_to(typical, (len(nodes), 3, 3)))
