# SPDX-License-Identifier: Apache-2.0
"""Which closures agree with each other: pairwise consistency around short loops.

Two closures whose ends are near each other on the backbone make a loop that the drift since the
beginning does not enter (pairwise consistent measurements, Mangelson et al. 2018; clusters,
Latif, Cadena & Neira 2013). Those that agree form groups, which are judged as one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.graph.robust.inlier_evidence import evidence, fit_scale, uniform
from rlml_slam.graph.robust.spanning_forest import SpanningForest
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]
NEIGHBOURS = (
    8  # nearest closures, by the distance of their ends in poses, that each is tested with
)
RISK = 0.1  # chances that any of the wrong closures is linked to another by accident


class Groups(NamedTuple):
    """``label`` (k,) of each closure, ``size`` per label, and the ``scale`` of the covariances."""

    label: Ints
    size: Ints
    scale: float


def group(
    spanning_forest: SpanningForest, nodes: Ints, deltas: Array, covs: Array, area: float
) -> Groups:
    """Groups of closures (k, 2), (k, 3), covariances (k, 3, 3) of their residuals.

    ``area`` [m²] is the extent of the map.
    """
    k = len(nodes)
    a, b = _neighbours(spanning_forest, nodes)
    e, S = _loops(spanning_forest, nodes, deltas, covs, a, b)
    wrong = uniform(np.minimum(_reach(spanning_forest, nodes, deltas, a, b), area))
    scale = fit_scale(e, S, wrong)
    linked = evidence(e, S, scale, wrong) > math.log(max(k, 1) / RISK)
    links = sparse.csr_matrix((np.ones(linked.sum()), (a[linked], b[linked])), (k, k))
    count, label = sparse.csgraph.connected_components(links, directed=False)
    return Groups(label.astype(np.int64), np.bincount(label, minlength=count), scale)


def _neighbours(spanning_forest: SpanningForest, nodes: Ints) -> tuple[Ints, Ints]:
    """Pairs a < b of closures whose ends lie in the same pieces and near each other."""
    if len(nodes) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    ends = nodes.astype(np.float64)
    near = cKDTree(ends).query(ends, min(NEIGHBOURS + 1, len(nodes)), p=1)[1]
    a, b = np.repeat(np.arange(len(nodes)), near.shape[1]), near.ravel()
    a, b = np.unique(np.sort(np.stack([a, b], -1), axis=1)[a != b], axis=0).T
    same = (spanning_forest.piece[nodes[a]] == spanning_forest.piece[nodes[b]]).all(1)
    return a[same], b[same]


def _loops(
    spanning_forest: SpanningForest, nodes: Ints, deltas: Array, covs: Array, a: Ints, b: Ints
) -> tuple[Array, Array]:
    """Error of closure b against the way over closure a, T_ib_ia z_a T_ja_jb, and covariance."""
    T_i, S_i = spanning_forest.motion(nodes[b, 0], nodes[a, 0])
    T_j, S_j = spanning_forest.motion(nodes[a, 1], nodes[b, 1])
    rest = se2.compose(deltas[a], T_j)
    e = se2.between(deltas[b], se2.compose(T_i, rest))
    A, B = se2.adjoint(se2.inverse(T_j)), se2.adjoint(se2.inverse(rest))
    way = A @ covs[a] @ np.swapaxes(A, 1, 2) + B @ S_i @ np.swapaxes(B, 1, 2)
    return e, covs[b] + S_j + way


def _reach(spanning_forest: SpanningForest, nodes: Ints, deltas: Array, a: Ints, b: Ints) -> Array:
    """Area [m²] in which the error of a loop can lie at all: that of the length of its sides."""
    sides = (
        se2.between(spanning_forest.poses[nodes[b, 0]], spanning_forest.poses[nodes[a, 0]]),
        se2.between(spanning_forest.poses[nodes[a, 1]], spanning_forest.poses[nodes[b, 1]]),
        deltas[a], deltas[b],
    )  # fmt: skip
    length = sum(np.hypot(side[:, 0], side[:, 1]) for side in sides)
    # closures of no length between the same poses would leave no area
    return np.asarray(np.pi * np.maximum(length, 1e-3) ** 2)
