# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances of poses and landmarks: blocks of the inverse of the normal matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from rlml_slam.errors import SolverError
from rlml_slam.graph.graph import Graph
from rlml_slam.graph.normal_equations import check_finite, normal_equations, unknowns
from rlml_slam.se2 import Array


class Marginals:
    """Covariances at the current estimate of ``graph``, in the axes of the map.

    Robust weights count as information. A fixed node, and one that no enabled factor touches, has
    covariance zero. Raises SolverError if the normal equations are singular.
    """

    def __init__(self, graph: Graph) -> None:
        check_finite(graph)
        self._columns = unknowns(graph)
        try:
            self._factor = splu(
                normal_equations(graph, self._columns).H, permc_spec='MMD_AT_PLUS_A',
                diag_pivot_thresh=0.0, options={'SymmetricMode': True},
            )  # fmt: skip
        except RuntimeError as error:
            raise SolverError(f'normal equations cannot be solved: {error}') from None

    def poses(self, indices: ArrayLike) -> Array:
        """Covariances (k, 3, 3) of the poses ``indices`` (k,)."""
        at = self._columns.poses[np.asarray(indices, dtype=np.int64)]
        return self._blocks(at, 3, at, 3)

    def landmarks(self, indices: ArrayLike) -> Array:
        """Covariances (k, 2, 2) of the landmarks ``indices`` (k,)."""
        at = self._columns.landmarks[np.asarray(indices, dtype=np.int64)]
        return self._blocks(at, 2, at, 2)

    def cross(self, pose: int, landmarks: ArrayLike) -> Array:
        """Covariances (k, 3, 2) between one pose and the landmarks (k,)."""
        joint = self.joint([pose], landmarks)
        k = len(np.asarray(landmarks, dtype=np.int64))
        return np.swapaxes(joint[:3, 3:].reshape(3, k, 2), 0, 1)

    def joint(self, poses: ArrayLike, landmarks: ArrayLike = ()) -> Array:
        """Joint covariance (3k + 2l, 3k + 2l) of the poses (k,), then the landmarks (l,)."""
        p = self._columns.poses[np.asarray(poses, dtype=np.int64).reshape(-1)]
        q = self._columns.landmarks[np.asarray(landmarks, dtype=np.int64).reshape(-1)]
        at = np.concatenate([
            np.where(p[:, None] < 0, -1, p[:, None] + np.arange(3)).ravel(),
            np.where(q[:, None] < 0, -1, q[:, None] + np.arange(2)).ravel(),
        ])  # fmt: skip
        free = np.flatnonzero(at >= 0)
        unit = np.zeros((self._columns.size, len(free)))
        unit[at[free], np.arange(len(free))] = 1.0
        out = np.zeros((len(at), len(at)))
        out[np.ix_(free, free)] = self._factor.solve(unit)[at[free]]
        return 0.5 * (out + out.T)

    def _blocks(self, at: NDArray[np.int64], d: int, to: NDArray[np.int64], e: int) -> Array:
        out = np.zeros((len(at), d, e))
        for k in np.flatnonzero((at >= 0) & (to >= 0)):
            unit = np.zeros((self._columns.size, e))
            unit[to[k] + np.arange(e), np.arange(e)] = 1.0
            out[k] = self._factor.solve(unit)[at[k] : at[k] + d]
        return out
