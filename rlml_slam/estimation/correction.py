# SPDX-License-Identifier: Apache-2.0
"""Correction of the local frame by the back end, and the covariance of a pose in the map.

A corrected pose is the newest keyframe of the graph plus the motion of the front end since then.
Its covariance in the map is therefore that of the keyframe in the graph, transported along this
motion, plus the growth of the covariance of the front end since the keyframe. The covariance of
the front end alone is that of another estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.compiled import brief
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class ReferencePose:
    """A keyframe with both covariances: ``pose`` (3,) and ``cov_local`` (3, 3) in the local frame.

    ``cov_map`` (3, 3) is its marginal covariance in the graph, in the map frame.
    """

    pose: Array
    cov_local: Array
    cov_map: Array


@dataclass(frozen=True)
class Correction:
    """Pose ``T_map_local`` (3,), and the ``reference`` keyframe once the graph has one."""

    T_map_local: Array
    reference: ReferencePose | None = None

    def apply(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (3,) of the local frame and its covariance (3, 3) there, both in the map."""
        r = self.reference
        if r is None:
            return se2.compose_belief(self.T_map_local, pose, cov)
        return _since(self.T_map_local, pose, cov, r.pose, r.cov_local, r.cov_map)


@brief
def carried(cov: Array, way: Array) -> Array:
    """Covariance (3, 3) of a pose at offset ``way`` (2,) from one with covariance ``cov`` (3, 3).

    J cov J^T with J = [[1, 0, -y], [0, 1, x], [0, 0, 1]]: the two poses are rigidly connected,
    and all axes are those of one frame.
    """
    J = np.array([[1.0, 0.0, -way[1]], [0.0, 1.0, way[0]], [0.0, 0.0, 1.0]])
    out: Array = np.dot(np.dot(J, cov), J.T.copy())
    return out


@brief
def positive(A: Array) -> Array:
    """The positive semidefinite part of a symmetric matrix (n, n)."""
    values, axes = np.linalg.eigh(0.5 * (A + A.T))
    out: Array = np.dot(axes * np.maximum(values, 0.0), axes.T.copy())
    return out


@brief
def _since(
    T_map_local: Array, pose: Array, cov: Array, then: Array, cov_then: Array, cov_map: Array
) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) in the map, from those of the reference ``then``."""
    way = pose[:2] - then[:2]
    grown = positive(cov - carried(cov_then, way))
    T_map_base, grown = se2.compose_belief(T_map_local, pose, grown)
    c, s = math.cos(T_map_local[2]), math.sin(T_map_local[2])
    there = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1]])
    return T_map_base, carried(cov_map, there) + grown


def either(P: Array, Q: Array) -> Array:
    """Smallest covariance (3, 3) that is, along common axes, not smaller than P or Q."""
    # Q may be singular, that of the pose where all began
    L = np.linalg.cholesky(Q + 1e-14 * np.eye(len(Q)))
    inverse = np.linalg.inv(L)
    values, axes = np.linalg.eigh(inverse @ P @ inverse.T)
    root = L @ axes
    return np.asarray((root * np.maximum(values, 1.0)) @ root.T)


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    known = ReferencePose(np.zeros(3), np.eye(3), np.eye(3))
    Correction(np.zeros(3), known).apply(np.zeros(3), np.eye(3))
    positive(np.eye(3))
    measured = np.zeros(2)
    carried(np.eye(3), measured)
    measured.setflags(write=False)  # as an edge's is, which Numba takes for another type
    carried(np.eye(3), measured)
