# SPDX-License-Identifier: Apache-2.0
"""Bound of the error of a relative pose: the most certain path of edges between two poses.

The covariance of a relative pose by the whole graph is no larger than that along any one path
(Olson, "Robust and efficient robotic mapping", 2008: the Dijkstra projection). Along a path,
standard deviations are added, not variances: that bounds the error however the errors of the edges
are correlated, as those of a worn wheel or a bent corridor are. It takes the time of a shortest
path search, and no normal equations are solved.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]


def path_bound(graph: Graph, pose: int, others: Ints) -> Array:
    """Bounds (k, 2) of the sigma [m], [rad] of where ``pose`` is, relative to ``others`` (k,).

    The first is the root of the variances of x and y together. Infinite where no path of enabled
    edges leads there; sightings are not part of paths.
    """
    e = graph.edges
    targets = np.asarray(others, dtype=np.int64)
    return _search(graph.poses, e.nodes, e.information, e.enabled, pose, targets)


@kernel
def _search(
    poses: Array, nodes: Ints, information: Array, enabled: NDArray[np.bool_], pose: int,
    others: Ints,
) -> Array:  # fmt: skip
    """Dijkstra's search from ``pose`` until all others are reached."""
    n, num = len(poses), len(nodes)
    starts = np.zeros(n + 1, np.int64)
    for e in range(num):
        if enabled[e]:
            starts[nodes[e, 0]] += 1
            starts[nodes[e, 1]] += 1
    for k in range(n):
        starts[k + 1] += starts[k]
    edges = np.empty(starts[n], np.int64)
    for e in range(num):
        if enabled[e]:
            for side in range(2):
                starts[nodes[e, side]] -= 1
                edges[starts[nodes[e, side]]] = e
    far, turn = np.full(n, np.inf), np.full(n, np.inf)
    done, wanted = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    left = 0
    for k in others:
        left += not wanted[k]
        wanted[k] = True
    heap, at = np.empty(len(edges) + 1), np.empty(len(edges) + 1, np.int64)
    heap[0], at[0], size = 0.0, pose, 1
    far[pose] = turn[pose] = 0.0
    while size and left:
        k = at[0]
        size -= 1
        heap[0], at[0] = heap[size], at[size]
        _sink(heap, at, size)
        if done[k]:
            continue
        done[k] = True
        left -= wanted[k]
        for p in range(starts[k], starts[k + 1]):
            e = edges[p]
            o = nodes[e, 0] + nodes[e, 1] - k
            if done[o]:
                continue
            sigma, angle = _sigmas(poses, nodes[e, 1], information[e], pose)
            if far[k] + sigma < far[o]:
                far[o], turn[o] = far[k] + sigma, turn[k] + angle
                heap[size], at[size] = far[o], o
                size += 1
                _rise(heap, at, size - 1)
    out = np.empty((len(others), 2))
    for k in range(len(others)):
        out[k, 0], out[k, 1] = far[others[k]], turn[others[k]]
    return out


@part
def _sigmas(poses: Array, j: int, information: Array, pose: int) -> tuple[float, float]:
    """Sigma of where ``pose`` comes to lie by the error of an edge to pose j, and of its turn."""
    a, b, c = information[0, 0], information[0, 1], information[0, 2]
    d, e, f = information[1, 1], information[1, 2], information[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    xx, xt, yy, yt, tt = A, C, a * f - c * c, b * c - a * e, a * d - b * b
    # the pose as j sees it: that is the lever of the turn
    x, y = poses[pose, 0] - poses[j, 0], poses[pose, 1] - poses[j, 1]
    cos, sin = math.cos(poses[j, 2]), math.sin(poses[j, 2])
    u, v = cos * x + sin * y, cos * y - sin * x
    var = xx + yy - 2.0 * v * xt + 2.0 * u * yt + (u * u + v * v) * tt
    return math.sqrt(max(var, 0.0) / det), math.sqrt(max(tt, 0.0) / det)


@part
def _sink(heap: Array, at: Ints, size: int) -> None:
    """Sift the first entry of a binary heap down."""
    k = 0
    while 2 * k + 1 < size:
        child = 2 * k + 1
        if child + 1 < size and heap[child + 1] < heap[child]:
            child += 1
        if heap[k] <= heap[child]:
            return
        heap[k], heap[child] = heap[child], heap[k]
        at[k], at[child] = at[child], at[k]
        k = child


@part
def _rise(heap: Array, at: Ints, k: int) -> None:
    """Sift entry k of a binary heap up."""
    while k and heap[k] < heap[(k - 1) // 2]:
        up = (k - 1) // 2
        heap[k], heap[up] = heap[up], heap[k]
        at[k], at[up] = at[up], at[k]
        k = up


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    graph = Graph()
    graph.add_poses(np.zeros((2, 3)))
    path_bound(graph, 0, np.array([1]))
