# SPDX-License-Identifier: Apache-2.0
"""Starts for a solve when the estimate at hand is bad: spanning tree and chordal relaxation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from rlml_slam.errors import SolverError
from rlml_slam.graph.graph import Graph
from rlml_slam.se2 import Array, compose, inverse, rotation, transform, wrap

METHODS = ('none', 'auto', 'odometry', 'spanning_tree', 'chordal')


def initialize(graph: Graph, method: str) -> None:
    """Overwrite the free nodes by ``method``; 'auto' keeps the start if chordal is not better."""
    if method not in METHODS:
        raise SolverError(f'initialization {method!r} is none of {", ".join(METHODS)}')
    if method == 'none' or not len(graph.poses):
        return
    if method == 'odometry':
        spanning_tree(graph, consecutive_first=True)
    elif method == 'spanning_tree':
        spanning_tree(graph)
    elif method == 'chordal':
        chordal(graph)
    else:
        dof = 3 * len(graph.edges) + 2 * len(graph.sightings)
        best = graph.chi2(), graph.poses.copy(), graph.landmarks.copy()
        if best[0] <= 2.0 * dof:
            return
        for candidate in (spanning_tree, chordal):
            candidate(graph)
            value = graph.chi2()
            if value < best[0]:
                best = value, graph.poses.copy(), graph.landmarks.copy()
        graph.poses[:], graph.landmarks[:] = best[1:]


def _roots(graph: Graph) -> NDArray[np.int64]:
    roots = np.flatnonzero(graph.fixed_poses)
    p = graph.pose_priors
    return np.unique(np.concatenate([roots, p.nodes[p.enabled][:, 0], [0]]))


def spanning_tree(graph: Graph, consecutive_first: bool = False) -> None:
    """Poses by breadth-first composition of edges from the fixed ones; landmarks from sightings.

    With ``consecutive_first`` an edge i to i + 1 is preferred (plain odometry).
    """
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    i, j = e.nodes[use].T
    cost = np.where(np.abs(i - j) == 1, 1.0, 1e6 if consecutive_first else 1.0)
    n = len(graph.poses)
    known = np.zeros(n, dtype=np.bool_)
    roots = _roots(graph)
    known[roots] = True
    _compose_tree(graph, use, cost, roots)
    place_landmarks(graph)


def _compose_tree(
    graph: Graph, use: NDArray[np.int64], cost: Array, roots: NDArray[np.int64]
) -> None:
    n = len(graph.poses)
    i, j = graph.edges.nodes[use].T
    # the cheapest of parallel edges
    order = np.lexsort((np.arange(len(use)), cost))[::-1]
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


def place_landmarks(graph: Graph) -> None:
    """Free landmarks at the mean of where their enabled sightings put them."""
    s = graph.sightings
    use = np.flatnonzero(s.enabled)
    if not len(use):
        return
    a, k = s.nodes[use].T
    points = transform(graph.poses[a], s.measured[use][:, None, :])[:, 0]
    total = np.zeros_like(graph.landmarks)
    np.add.at(total, k, points)
    count = np.bincount(k, minlength=len(graph.landmarks))
    move = (count > 0) & ~graph.fixed_landmarks
    graph.landmarks[move] = total[move] / count[move, None]


def chordal(graph: Graph) -> None:
    """Rotations from the chordal relaxation, then positions with these rotations held.

    Minimises the sum of w |r_j - R(delta) r_i|^2 over unconstrained 2-vectors r = (cos, sin) with
    the fixed poses' r given, and projects on the circle (Martinec & Pajdla 2007; Carlone et al.
    2015); w is the edge's information of the angle. Poses that no edge connects to a fixed one
    start from the spanning tree.
    """
    spanning_tree(graph)
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    roots = _roots(graph)
    free = np.ones(len(graph.poses), dtype=np.bool_)
    free[roots] = False
    i, j = e.nodes[use].T
    touched = np.zeros(len(graph.poses), dtype=np.bool_)
    touched[i] = touched[j] = True
    free &= touched
    column = np.where(free, np.cumsum(free) - 1, -1)
    w = e.information[use][:, 2, 2]
    turn = np.exp(1j * e.measured[use][:, 2])
    z = np.exp(1j * graph.poses[:, 2])
    z[free] = _complex_solve(column, i, j, w, turn, z)
    graph.poses[:, 2] = wrap(np.where(free & (np.abs(z) > 1e-9), np.angle(z), graph.poses[:, 2]))
    # positions: t_j - t_i = R_i t_delta, the same kind of problem with turn = 1
    R = rotation(graph.poses[:, 2])
    step = (R[i] @ e.measured[use][:, :2, None])[..., 0] @ np.array([1.0, 1j])
    t = graph.poses[:, 0] + 1j * graph.poses[:, 1]
    weight = 0.5 * (e.information[use][:, 0, 0] + e.information[use][:, 1, 1])
    t[free] = _complex_solve(column, i, j, weight, np.ones(len(use), np.complex128), t, step)
    graph.poses[free, 0], graph.poses[free, 1] = t.real[free], t.imag[free]
    place_landmarks(graph)


def _complex_solve(
    column: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64], w: Array,
    turn: NDArray[np.complex128], given: NDArray[np.complex128],
    step: NDArray[np.complex128] | float = 0.0,
) -> NDArray[np.complex128]:  # fmt: skip
    """Minimise the sum of w |x_j - turn x_i - step|^2 over the x with a column."""
    size = int(column.max(initial=-1)) + 1
    ci, cj = column[i], column[j]
    fi, fj = ci >= 0, cj >= 0
    both = fi & fj
    rows = np.concatenate([ci[fi], cj[fj], ci[both], cj[both]])
    cols = np.concatenate([ci[fi], cj[fj], cj[both], ci[both]])
    off = -w[both] * np.conj(turn[both])
    values = np.concatenate([w[fi], w[fj], off, np.conj(off)]).astype(np.complex128)
    b = np.zeros(size, dtype=np.complex128)
    step = np.broadcast_to(step, w.shape)
    np.add.at(b, cj[fj], (w * step)[fj])
    np.add.at(b, ci[fi], -(w * np.conj(turn) * step)[fi])
    only_i, only_j = fi & ~fj, fj & ~fi
    np.add.at(b, cj[only_j], (w * turn * given[i])[only_j])
    np.add.at(b, ci[only_i], (w * np.conj(turn) * given[j])[only_i])
    H = sparse.coo_matrix((values, (rows, cols)), (size, size)).tocsc()
    return np.asarray(splu(H, permc_spec='MMD_AT_PLUS_A').solve(b)) if size else b
