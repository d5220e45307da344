# SPDX-License-Identifier: Apache-2.0
"""Relative poses and their covariances by the trusted edges alone, along a spanning forest.

Covariances add up when they are all expressed in the
root's frame: with X_j = X_i D exp(t), exp(t) = exp(Ad(X_j) t) on the left of the whole chain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]


class SpanningForest:
    """Breadth-first forest over the edges ``use`` (k,) of a graph.

    ``poses`` (n, 3) start at the estimate of each root; ``piece`` (n,) numbers the trees.
    """

    def __init__(self, graph: Graph, use: Ints) -> None:
        n = len(graph.poses)
        i, j = graph.edges.nodes[use].T
        links = sparse.csr_matrix((np.ones(len(use)), (i, j)), (n, n))
        self.pieces, self.piece = sparse.csgraph.connected_components(links, directed=False)
        roots = np.full(self.pieces, n)
        np.minimum.at(roots, self.piece, np.arange(n))
        fixed = np.flatnonzero(graph.fixed_poses)
        roots[self.piece[fixed]] = fixed
        # the roots hang below an extra node, so that one search starts from all of them
        rows, cols = np.concatenate([i, np.full(len(roots), n)]), np.concatenate([j, roots])
        links = sparse.csr_matrix((np.ones(len(rows)), (rows, cols)), (n + 1, n + 1))
        order, parent = sparse.csgraph.breadth_first_order(links, n, directed=False)
        self.poses = graph.poses.copy()
        self._cov = np.zeros((n, 3, 3))
        edge = {(int(a), int(b)): int(k) for k, a, b in zip(use, i, j, strict=True)}
        self._depth = np.zeros(n + 1, dtype=np.int64)
        self._parent = np.where(parent < 0, n, parent).astype(np.int64)
        for b in order[1:]:
            self._depth[b] = self._depth[parent[b]] + 1
            if parent[b] < n:
                self._attach(graph, edge, int(parent[b]), int(b))
        self._above = self._ancestors()

    def _attach(self, graph: Graph, edge: dict[tuple[int, int], int], a: int, b: int) -> None:
        """Pose and covariance of b from those of its parent a."""
        forward = (a, b) in edge
        k = edge[(a, b) if forward else (b, a)]
        delta, cov = graph.edges.measured[k], np.linalg.inv(graph.edges.information[k])
        self.poses[b] = se2.compose(self.poses[a], delta if forward else se2.inverse(delta))
        # the residual is a twist of the frame that the edge points to
        A = se2.adjoint(self.poses[b] if forward else self.poses[a])
        self._cov[b] = self._cov[a] + A @ cov @ A.T

    def _ancestors(self) -> Ints:
        """Ancestor of each node 1, 2, 4 … generations up."""
        rows = [self._parent]
        for _ in range(int(self._depth.max()).bit_length()):
            rows.append(rows[-1][rows[-1]])
        return np.array(rows)

    def _common(self, i: Ints, j: Ints) -> Ints:
        """Nearest common ancestors, by doubling."""
        swap = self._depth[i] < self._depth[j]
        a, b = np.where(swap, j, i), np.where(swap, i, j)
        gap = self._depth[a] - self._depth[b]
        for k, up in enumerate(self._above):
            a = np.where(gap >> k & 1, up[a], a)
        for up in self._above[::-1]:
            differ = up[a] != up[b]
            a, b = np.where(differ, up[a], a), np.where(differ, up[b], b)
        return np.asarray(np.where(a == b, a, self._parent[a]))

    def motion(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        """T_i_j (k, 3) and its covariance (k, 3, 3) in the axes of j, for poses of one piece."""
        T = se2.between(self.poses[i], self.poses[j])
        A = se2.adjoint(se2.inverse(self.poses[j]))
        path = self._cov[i] + self._cov[j] - 2.0 * self._cov[self._common(i, j)]
        return T, A @ path @ np.swapaxes(A, 1, 2)
