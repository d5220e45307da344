# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a graph with NumPy and SciPy: H dx = -g, H = J^T W J sparse.

From the batched factors: the oracle that the compiled solver is held against.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rlml_slam.errors import SolverError
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.factor_table import FactorTable
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Unknowns:
    """Column of each pose and landmark in H, -1 where it is not solved for, and their number."""

    poses: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    size: int


def unknowns(graph: Graph) -> Unknowns:
    """Which nodes are solved for: not fixed and touched by an enabled factor.

    Raises SolverError that names a node of a connected part that nothing ties to the map: no
    fixed pose, no pose prior and not two fixed or surveyed landmarks.
    """
    n, m = len(graph.poses), len(graph.landmarks)
    e, s = graph.edges, graph.sightings
    pairs = np.concatenate(
        [e.nodes[e.enabled], s.nodes[s.enabled] + np.array([0, n])], axis=0
    )  # landmark k is node n + k
    p = graph.pose_priors.nodes[graph.pose_priors.enabled][:, 0]
    q = graph.landmark_priors.nodes[graph.landmark_priors.enabled][:, 0] + n
    touched = np.zeros(n + m, dtype=np.bool_)
    for nodes in (pairs.ravel(), p, q):
        touched[nodes] = True
    fixed = np.concatenate([graph.fixed_poses, graph.fixed_landmarks])
    anchors = np.zeros(n + m)
    anchors[:n][graph.fixed_poses] = 2
    anchors[n:][graph.fixed_landmarks] = 1
    anchors[p] = 2
    np.maximum.at(anchors, q, 1)
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n + m, n + m))
    num, part = sparse.csgraph.connected_components(links, directed=False)
    # a lone landmark with a prior needs no heading
    total = np.bincount(part, weights=anchors, minlength=num)
    has_pose = np.bincount(part[:n], minlength=num) > 0
    loose = touched & ~fixed & (total < np.where(has_pose, 2, 1))[part]
    if loose.any():
        i = int(np.argmax(loose))
        name = f'pose {i}' if i < n else f'landmark {i - n}'
        raise SolverError(
            f'{name} and what is connected to it is not anchored to the map: '
            'fix a pose, or add a prior or two fixed landmarks'
        )
    width = np.where(np.arange(n + m) < n, 3, 2) * (touched & ~fixed)
    column = np.where(width > 0, np.cumsum(width) - width, -1)
    return Unknowns(column[:n], column[n:], int(width.sum()))


@dataclass(frozen=True)
class NormalEquations:
    """H (sparse, csc), g = J^T W e, the robust cost and the plain chi2."""

    H: sparse.csc_matrix
    g: Array
    cost: float
    chi2: float


def normal_equations(graph: Graph, columns: Unknowns, weighted: bool = True) -> NormalEquations:
    """Linearised at the current estimate; ``weighted`` applies the losses' weights."""
    X, m = graph.poses, graph.landmarks
    e, s, p, q = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
    i, j = e.nodes.T
    a, k = s.nodes.T
    parts = [
        (e, factors.relative_pose(X[i], X[j], e.measured), (columns.poses[i], columns.poses[j])),
        (s, factors.pose_landmark(X[a], m[k], s.measured, s.kinds),
         (columns.poses[a], columns.landmarks[k])),
        (p, factors.pose_prior(X[p.nodes[:, 0]], p.measured), (columns.poses[p.nodes[:, 0]],)),
        (q, factors.landmark_prior(m[q.nodes[:, 0]], q.measured),
         (columns.landmarks[q.nodes[:, 0]],)),
    ]  # fmt: skip
    rows: list[Array] = []
    cols: list[Array] = []
    values: list[Array] = []
    g = np.zeros(columns.size)
    cost = chi2 = 0.0
    for table, (r, *jacobians), starts in parts:
        squared = np.where(table.enabled, factors.chi2(r, table.information), 0.0)
        rho, w = _robust(graph, table, squared)
        cost += float(rho.sum())
        chi2 += float(squared.sum())
        WI = table.information * ((w if weighted else 1.0) * table.enabled)[:, None, None]
        for J_a, start_a in zip(jacobians, starts, strict=True):
            JW = np.swapaxes(J_a, 1, 2) @ WI
            at_a = start_a[:, None] + np.arange(J_a.shape[2])
            free = start_a >= 0
            np.add.at(g, at_a[free], (JW @ r[:, :, None])[free, :, 0])
            for J_b, start_b in zip(jacobians, starts, strict=True):
                both = free & (start_b >= 0)
                block = (JW @ J_b)[both]
                at_b = start_b[both, None] + np.arange(J_b.shape[2])
                rows.append(np.broadcast_to(at_a[both][:, :, None], block.shape).ravel())
                cols.append(np.broadcast_to(at_b[:, None, :], block.shape).ravel())
                values.append(block.ravel())
    shape = (columns.size, columns.size)
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
    return NormalEquations(sparse.coo_matrix(triplets, shape).tocsc(), g, cost, chi2)


def _robust(graph: Graph, table: FactorTable, squared: Array) -> tuple[Array, Array]:
    rho, w = squared.copy(), np.ones_like(squared)
    for kind, one in enumerate(graph.losses.in_order()):
        if one.kind != 0:
            for i in np.flatnonzero(table.kinds == kind):
                rho[i], w[i] = loss(int(one.kind), one.scale, squared[i])
    return rho, w


def check_finite(graph: Graph) -> None:
    """Raise SolverError that names the first pose or landmark that is not finite."""
    for name, values in (('pose', graph.poses), ('landmark', graph.landmarks)):
        finite = np.isfinite(values).all(-1)
        if not finite.all():
            i = int(np.argmin(finite))
            raise SolverError(f'{name} {i}: {values[i].tolist()} is not finite')
