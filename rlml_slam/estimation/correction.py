# SPDX-License-Identifier: Apache-2.0
"""The back end's correction of the local frame, and how well a pose is known in the map by it.

A corrected pose is the graph's newest keyframe and the way that the front end went since. So is
its error: the covariance in the map is that of the keyframe in the graph, carried along, and what
the front end's has grown by since. That of the front end alone is not: it is of another estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.compiled import brief
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Known:
    """A pose of the local frame: ``pose`` (3,) and ``cov_local`` (3, 3) as the front end had it.

    ``cov_map`` (3, 3) is its covariance in the map, by the graph.
    """

    pose: Array
    cov_local: Array
    cov_map: Array


@dataclass(frozen=True)
class Correction:
    """``T_map_local`` (3,) and, once the graph says so, how well a pose is ``known`` with it."""

    T_map_local: Array
    known: Known | None = None

    def apply(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (3,) of the local frame and its covariance (3, 3) there, both in the map."""
        k = self.known
        if k is None:
            return se2.compose_belief(self.T_map_local, pose, cov)
        return _since(self.T_map_local, pose, cov, k.pose, k.cov_local, k.cov_map)


@brief
def carried(cov: Array, way: Array) -> Array:
    """Covariance (3, 3) of a pose that lies ``way`` (2,) from one of covariance ``cov`` (3, 3).

    The two are tied rigidly, and all is in the axes of one frame: a heading error moves the far
    end sideways.
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
    """The pose and its covariance in the map, where those of the pose ``then`` are known."""
    way = pose[:2] - then[:2]
    grown = positive(cov - carried(cov_then, way))
    T_map_base, turned = se2.compose_belief(T_map_local, pose, grown)
    c, s = math.cos(T_map_local[2]), math.sin(T_map_local[2])
    there = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1]])
    return T_map_base, carried(cov_map, there) + turned


def turned(cov: Array, angle: float) -> Array:
    """Covariance (3, 3) of a pose, from the axes of a frame that lies at ``angle`` to the others.

    From those of the pose itself, that is its heading, and back by the heading's negative.
    """
    R = np.eye(3)
    R[:2, :2] = se2.rotation(angle)
    out: Array = R @ cov @ R.T
    return out


def either(P: Array, Q: Array) -> Array:
    """The least covariance (3, 3) that is, along common axes, no smaller than P or than Q."""
    # Q may be singular, that of the pose where all began
    L = np.linalg.cholesky(Q + 1e-14 * np.eye(len(Q)))
    inverse = np.linalg.inv(L)
    values, axes = np.linalg.eigh(inverse @ P @ inverse.T)
    root = L @ axes
    return np.asarray((root * np.maximum(values, 1.0)) @ root.T)


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    known = Known(np.zeros(3), np.eye(3), np.eye(3))
    Correction(np.zeros(3), known).apply(np.zeros(3), np.eye(3))
    positive(np.eye(3))
    measured = np.zeros(2)
    carried(np.eye(3), measured)
    measured.setflags(write=False)  # as an edge's is, which Numba takes for another type
    carried(np.eye(3), measured)
