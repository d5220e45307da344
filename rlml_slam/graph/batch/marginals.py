# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances of poses and landmarks: blocks of the inverse of the normal matrix."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.gauss_newton import factor
from rlml_slam.graph.batch.selected_inverse import columns, joint, selected_blocks
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.linearization import linearize
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind


class Marginals:
    """Covariances at the current estimate of ``graph``, in the axes of the map.

    Robust weights count as information. A fixed node, and one that no enabled factor touches, has
    covariance zero. Raises SolverError if the normal equations are singular, naming a node.
    """

    def __init__(self, graph: Graph) -> None:
        self._system = system = build_system(graph)
        linearize(system, graph.poses, graph.landmarks, True)
        failed = factor(system)
        num_poses = len(graph.poses)
        if failed >= 0:
            node = int(system.variables[system.structure.order[system.fronts[failed]['first']]][0])
            name = f'pose {node}' if node < num_poses else f'landmark {node - num_poses}'
            raise SolverError(f'normal equations are singular near {name}: too few measurements')
        nodes = num_poses + len(graph.landmarks)
        self._variable = np.full(nodes, -1, dtype=np.int64)
        self._variable[system.variables['node']] = np.arange(len(system.variables))
        self._landmark = num_poses

    @cached_property
    def _blocks(self) -> Array:
        return selected_blocks(self._system, False)[0]

    def poses(self, indices: ArrayLike) -> Array:
        """Covariances (k, 3, 3) of the poses ``indices`` (k,)."""
        return self._pick(self._variable[: self._landmark][_indices(indices)])

    def landmarks(self, indices: ArrayLike) -> Array:
        """Covariances (k, 2, 2) of the landmarks ``indices`` (k,)."""
        return self._pick(self._variable[self._landmark :][_indices(indices)])[:, :2, :2]

    def cross(self, pose: int, landmarks: ArrayLike) -> Array:
        """Covariances (k, 3, 2) between one pose and the landmarks (k,)."""
        return self._with_pose(pose, self._rows((), landmarks), 2)

    def pose_columns(self, pose: int, others: ArrayLike) -> Array:
        """Covariances (k, 3, 3) between one pose and the poses ``others`` (k,)."""
        return self._with_pose(pose, self._rows(others, ()), 3)

    def edges(self) -> Array:
        """Covariances (e, 3, 3) between the poses i and j of each enabled edge."""
        return selected_blocks(self._system, True)[1]

    def joint(self, poses: ArrayLike, landmarks: ArrayLike = ()) -> Array:
        """Joint covariance (3k + 2l, 3k + 2l) of the poses (k,), then the landmarks (l,)."""
        at = self._rows(poses, landmarks)
        free = np.flatnonzero(at >= 0)
        out = np.zeros((len(at), len(at)))
        out[np.ix_(free, free)] = joint(self._system, at[free])
        return out

    def _with_pose(self, pose: int, rows: NDArray[np.int64], size: int) -> Array:
        """Covariances (k, 3, size) between one pose and the nodes of ``rows`` (k size,)."""
        own, free = self._rows([pose], ()), rows >= 0
        out = np.zeros((3, len(rows)))
        if own[0] >= 0:
            out[:, free] = columns(self._system, own)[:, rows[free]]
        return np.swapaxes(out.reshape(3, -1, size), 0, 1)

    def _pick(self, variables: NDArray[np.int64]) -> Array:
        out = np.zeros((len(variables), 3, 3))
        out[variables >= 0] = self._blocks[variables[variables >= 0]]
        return out

    def _rows(self, poses: ArrayLike, landmarks: ArrayLike) -> NDArray[np.int64]:
        """Rows of the system that belong to the poses (3 each) and landmarks (2 each), or -1."""
        rows = []
        for variables, size in (
            (self._variable[: self._landmark][_indices(poses)], 3),
            (self._variable[self._landmark :][_indices(landmarks)], 2),
        ):
            first = self._system.variables['scalar'][np.maximum(variables, 0)]
            each = first[:, None] + np.arange(size)
            rows.append(np.where(variables[:, None] < 0, -1, each).ravel())
        return np.concatenate(rows)


def _indices(indices: ArrayLike) -> NDArray[np.int64]:
    return np.asarray(indices, dtype=np.int64).reshape(-1)


def warm_up() -> None:
    """Compile the kernels of the covariances."""
    graph = Graph()
    graph.add_poses([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    graph.fixed_poses[0] = True
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1.0, 0.0, 0.0], np.eye(3))
    marginals = Marginals(graph)
    marginals.poses([1])
    marginals.edges()
    marginals.joint([1])
    marginals.pose_columns(1, [1])
