# SPDX-License-Identifier: Apache-2.0
"""Pose-landmark graph: poses, landmarks and the factors between them, in growing arrays.

Nodes and factors are named by their index, in the order they were added: a factor that turned out
wrong is disabled, and only ``keep`` removes nodes and factors, and renumbers the others. Fixed
nodes are the gauge. All poses and landmarks are in the map frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam.errors import SolverError
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.buffers import Buffers, buffers_of
from rlml_slam.graph.model.factor_table import Column, FactorTable, renumbered
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.packed_system import Tables
from rlml_slam.se2 import Array, compose, transform, wrap
from rlml_slam.types import EdgeKind

EDGE_KINDS = {
    EdgeKind.ODOMETRY: FactorKind.ODOMETRY,
    EdgeKind.SCAN: FactorKind.SCAN,
    EdgeKind.CLOSURE: FactorKind.CLOSURE,
}


@dataclass(frozen=True)
class Residuals:
    """Squared Mahalanobis norm e^T I e of every factor, enabled or not, by table."""

    edges: Array
    sightings: Array
    pose_priors: Array
    landmark_priors: Array


@dataclass(frozen=True)
class Renumbering:
    """New index of every node and factor after ``Graph.keep`` (n,), -1 for those removed."""

    poses: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    edges: NDArray[np.int64]
    sightings: NDArray[np.int64]
    pose_priors: NDArray[np.int64]
    landmark_priors: NDArray[np.int64]


class Graph:
    """Poses (n, 3), landmarks (m, 2) and four tables of factors.

    A table holds the factors between nodes of one sort: ``edges`` between poses, ``sightings``
    from poses to landmarks (seen as a point, or heard at a range), ``pose_priors`` and
    ``landmark_priors``. ``losses`` holds the robust loss per kind and may be replaced.
    """

    def __init__(self, losses: Losses | None = None) -> None:
        self.losses = losses or Losses()
        self._poses = Column((3,))
        self._landmarks = Column((2,))
        self._fixed_poses = Column((), np.bool_)
        self._fixed_landmarks = Column((), np.bool_)
        self.edges = FactorTable(('pose', 'pose'), 3)
        self.sightings = FactorTable(('pose', 'landmark'), 2)
        self.pose_priors = FactorTable(('pose',), 3)
        self.landmark_priors = FactorTable(('landmark',), 2)
        tables = self.edges, self.sightings, self.pose_priors, self.landmark_priors
        self._columns = (
            self._poses, self._landmarks, self._fixed_poses, self._fixed_landmarks,
            *(column for table in tables for column in table.columns),
        )  # fmt: skip
        self._addresses: Buffers | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but the addresses, which differ in a copy."""
        return {**self.__dict__, '_addresses': None}

    @property
    def poses(self) -> Array:
        """The current estimate (n, 3); a writable view, valid until the next add."""
        return self._poses.view

    @property
    def landmarks(self) -> Array:
        """The current estimate (m, 2); a writable view, valid until the next add."""
        return self._landmarks.view

    @property
    def fixed_poses(self) -> NDArray[np.bool_]:
        """Poses that the solver does not move (n,); writable."""
        return self._fixed_poses.view

    @property
    def fixed_landmarks(self) -> NDArray[np.bool_]:
        """Landmarks that the solver does not move (m,); writable."""
        return self._fixed_landmarks.view

    def add_pose(self, pose: ArrayLike, fixed: bool = False) -> int:
        """Add one pose (3,) and return its index; raises SolverError if it is not finite."""
        return int(self.add_poses(np.asarray(pose, dtype=np.float64)[None], fixed)[0])

    def add_poses(self, poses: ArrayLike, fixed: bool = False) -> NDArray[np.int64]:
        """Add poses (k, 3) and return their indices."""
        new = np.array(poses, dtype=np.float64).reshape(-1, 3)
        if len(new):
            new[:, 2] = wrap(new[:, 2])
        return _add_nodes('pose', self._poses, self._fixed_poses, new, fixed)

    def add_landmark(self, point: ArrayLike, fixed: bool = False) -> int:
        """Add one landmark (2,) and return its index; raises SolverError if it is not finite."""
        return int(self.add_landmarks(np.asarray(point, dtype=np.float64)[None], fixed)[0])

    def add_landmarks(self, points: ArrayLike, fixed: bool = False) -> NDArray[np.int64]:
        """Add landmarks (k, 2) and return their indices."""
        new = np.array(points, dtype=np.float64).reshape(-1, 2)
        return _add_nodes('landmark', self._landmarks, self._fixed_landmarks, new, fixed)

    def add_edge(
        self, kind: EdgeKind, i: int, j: int, delta: ArrayLike, information: ArrayLike
    ) -> int:
        """Add the measured motion delta = T_i_j (3,) and return the edge's index.

        ``information`` (3, 3) is that of the residual (factors.relative_pose); from a covariance
        of delta in the axes of i it comes by factors.relative_information.
        """
        return int(self.add_edges(kind, [[i, j]], delta, information)[0])

    def add_edges(
        self,
        kinds: EdgeKind | Sequence[EdgeKind],
        nodes: ArrayLike,
        deltas: ArrayLike,
        informations: ArrayLike,
    ) -> NDArray[np.int64]:
        """Add edges (k, 2), (k, 3), (k, 3, 3), of one kind or (k,), and return their indices."""
        n = len(self._poses)
        if isinstance(kinds, EdgeKind):
            codes: FactorKind | list[FactorKind] = EDGE_KINDS[kinds]
        else:
            codes = [EDGE_KINDS[kind] for kind in kinds]
        return self.edges.append(codes, nodes, deltas, informations, (n, n))

    def add_sighting(self, i: int, k: int, z: ArrayLike, information: ArrayLike) -> int:
        """Add landmark k seen at z (2,) in the frame of pose i; information (2, 2)."""
        return int(self.add_sightings([[i, k]], z, information)[0])

    def add_sightings(
        self, nodes: ArrayLike, z: ArrayLike, informations: ArrayLike
    ) -> NDArray[np.int64]:
        """Add sightings (k, 2) of (pose, landmark), (k, 2), (k, 2, 2); returns their indices."""
        sizes = (len(self._poses), len(self._landmarks))
        return self.sightings.append(FactorKind.REFLECTOR, nodes, z, informations, sizes)

    def add_range(self, i: int, k: int, distance: float, information: float) -> int:
        """Add the distance [m] of landmark k (a beacon) from pose i; information 1 / sigma^2."""
        return int(self.add_ranges([[i, k]], [distance], [information])[0])

    def add_ranges(
        self, nodes: ArrayLike, distances: ArrayLike, informations: ArrayLike
    ) -> NDArray[np.int64]:
        """Add ranges (k, 2) of (pose, landmark), (k,) [m], (k,) [1/m^2]; returns their indices.

        They are rows of ``sightings``: measured (r, 0), information diag(1 / sigma^2, 0). Fewer
        than three do not determine a landmark; from poses in a line, its mirror image fits too.
        """
        r = np.asarray(distances, dtype=np.float64).reshape(-1)
        if (r < 0.0).any():
            raise SolverError(f'range {r.min()} m is negative')
        measured, information = np.zeros((len(r), 2)), np.zeros((len(r), 2, 2))
        measured[:, 0] = r
        information[:, 0, 0] = np.asarray(informations, dtype=np.float64).reshape(-1)
        sizes = (len(self._poses), len(self._landmarks))
        return self.sightings.append(FactorKind.RANGE, nodes, measured, information, sizes)

    def add_pose_prior(self, i: int, pose: ArrayLike, information: ArrayLike) -> int:
        """Add a prior on pose i; information (3, 3) of (x, y, theta) in the map's axes."""
        kind, sizes = FactorKind.POSE_PRIOR, (len(self._poses),)
        return int(self.pose_priors.append(kind, [[i]], pose, information, sizes)[0])

    def add_landmark_prior(self, k: int, point: ArrayLike, information: ArrayLike) -> int:
        """Add a prior on landmark k (a survey); information (2, 2) in the map's axes."""
        kind, sizes = FactorKind.LANDMARK_PRIOR, (len(self._landmarks),)
        return int(self.landmark_priors.append(kind, [[k]], point, information, sizes)[0])

    def move(self, T: Array) -> None:
        """Transform all poses and landmarks by T (3,), the new pose of the old origin.

        Factors between nodes hold as before; priors are not transformed.
        """
        self.poses[:] = compose(T, self.poses)
        self.landmarks[:] = transform(T, self.landmarks)

    def keep(
        self,
        poses: NDArray[np.bool_],
        landmarks: NDArray[np.bool_],
        disabled: NDArray[np.bool_] | None = None,
    ) -> Renumbering:
        """Remove all other poses and landmarks with their factors, and disabled sightings.

        Of the disabled edges those of ``disabled`` (e,) stay, for they may be enabled again; by
        default all do. A solver of this graph has to be rebuilt, or renumbered, as an
        IncrementalSolver is by its ``renumber``.
        """
        new_poses, new_landmarks = renumbered(poses), renumbered(landmarks)
        e, s = self.edges.nodes, self.sightings.nodes
        seen = self.sightings.enabled & poses[s[:, 0]] & landmarks[s[:, 1]]
        known = np.all(poses[e], axis=-1)
        if disabled is not None:
            known &= self.edges.enabled | disabled
        p, q = self.pose_priors, self.landmark_priors
        out = Renumbering(
            new_poses, new_landmarks,
            self.edges.keep(known, (new_poses, new_poses)),
            self.sightings.keep(seen, (new_poses, new_landmarks)),
            p.keep(poses[p.nodes[:, 0]], (new_poses,)),
            q.keep(landmarks[q.nodes[:, 0]], (new_landmarks,)),
        )  # fmt: skip
        for column, kept in (
            (self._poses, poses), (self._fixed_poses, poses),
            (self._landmarks, landmarks), (self._fixed_landmarks, landmarks),
        ):  # fmt: skip
            column.keep(kept)
        return out

    def tables(self) -> Tables:
        """The buffers themselves, as the kernels take them; valid until the next add."""
        return Tables(
            self.fixed_poses, self.fixed_landmarks, self.edges.factors(),
            self.sightings.factors(), self.pose_priors.factors(), self.landmark_priors.factors(),
            self.losses.codes,
        )  # fmt: skip

    def addresses(self) -> Buffers:
        """Addresses of the buffers: poses, landmarks, then in the order of Tables.

        They are looked up again only where a buffer has moved or changed its length.
        """
        last = self._addresses
        if last is not None:
            for column, buffer in zip(self._columns, last.buffers, strict=True):
                if column.view is not buffer:
                    break
            else:
                return last
        self._addresses = buffers_of(tuple(column.view for column in self._columns), last)
        return self._addresses

    def residuals(self) -> Residuals:
        """Squared Mahalanobis norms of all factors at the current estimate."""
        X, m = self.poses, self.landmarks
        e, s, p, q = self.edges, self.sightings, self.pose_priors, self.landmark_priors
        i, j = e.nodes.T
        r_e = factors.relative_pose(X[i], X[j], e.measured)[0]
        i, k = s.nodes.T
        r_s = factors.pose_landmark(X[i], m[k], s.measured, s.kinds)[0]
        r_p = factors.pose_prior(X[p.nodes[:, 0]], p.measured)[0]
        r_q = factors.landmark_prior(m[q.nodes[:, 0]], q.measured)[0]
        return Residuals(
            factors.chi2(r_e, e.information), factors.chi2(r_s, s.information),
            factors.chi2(r_p, p.information), factors.chi2(r_q, q.information),
        )  # fmt: skip

    def chi2(self) -> float:
        """Sum of e^T I e over the enabled factors, without robust losses."""
        r = self.residuals()
        return float(
            r.edges[self.edges.enabled].sum()
            + r.sightings[self.sightings.enabled].sum()
            + r.pose_priors[self.pose_priors.enabled].sum()
            + r.landmark_priors[self.landmark_priors.enabled].sum()
        )


def _add_nodes(
    name: str, values: Column, fixed: Column, new: Array, is_fixed: bool
) -> NDArray[np.int64]:
    first = len(values)
    finite = np.isfinite(new).all(-1)
    if not finite.all():
        i = int(np.argmin(finite))
        raise SolverError(f'{name} {first + i}: {new[i].tolist()} is not finite')
    values.append(new)
    fixed.append(np.full(len(new), is_fixed))
    return np.arange(first, first + len(new))
