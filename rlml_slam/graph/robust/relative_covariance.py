# SPDX-License-Identifier: Apache-2.0
"""Covariances of relative poses by a graph, with and without an edge between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.model.factors import relative_pose
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array

Ints = NDArray[np.int64]
# share of an edge's covariance below which R - Q is the rounding of a difference of equal numbers
ROUNDING = 1e-9


def difference_covs(marginals: Marginals, poses: Array, i: Ints, j: Ints) -> Array:
    """Covariances (k, 3, 3), in the axes of j, of the poses j (k,) in the frames of i (k,)."""
    J_i, J_j = _jacobians(poses, i, j)
    out = np.empty((len(i), 3, 3))
    for first in np.unique(i):
        at = np.flatnonzero(i == first)
        cross = marginals.pose_columns(int(first), j[at])
        mixed = J_i[at] @ cross @ np.swapaxes(J_j[at], 1, 2)
        out[at] = mixed + np.swapaxes(mixed, 1, 2)
    return out + _carried(J_i, marginals.poses(i)) + _carried(J_j, marginals.poses(j))


def most_difference_covs(marginals: Marginals, poses: Array, i: Ints, j: Ints) -> Array:
    """At least those of ``difference_covs``: twice the sum of both, whatever the correlation."""
    J_i, J_j = _jacobians(poses, i, j)
    sums = _carried(J_i, marginals.poses(i)) + _carried(J_j, marginals.poses(j))
    return np.asarray(2.0 * sums)


def residual_covs(graph: Graph, marginals: Marginals) -> Array:
    """Covariances Q (k, 3, 3) that the whole graph leaves the residuals of its enabled edges."""
    use = np.flatnonzero(graph.edges.enabled)
    i, j = graph.edges.nodes[use].T
    _, J_i, J_j = relative_pose(graph.poses[i], graph.poses[j], graph.edges.measured[use])
    mixed = J_i @ marginals.edges() @ np.swapaxes(J_j, 1, 2)
    both = _carried(J_i, marginals.poses(i)) + _carried(J_j, marginals.poses(j))
    return np.asarray(both + mixed + np.swapaxes(mixed, 1, 2))


def left_out(graph: Graph, marginals: Marginals, edges: Ints) -> tuple[Array, Array]:
    """Errors (k, 3) of enabled ``edges`` (k,), ascending, against all but themselves; covariances.

    An edge with covariance R whose residual is r at the optimum, and has the covariance Q by the
    whole graph, had the error R (R - Q)^-1 r with covariance R (R - Q)^-1 R before it came in: the
    update of a Kalman filter, taken back.
    """
    e = graph.edges
    at = np.searchsorted(np.flatnonzero(e.enabled), edges)
    R = np.asarray(np.linalg.inv(e.information[edges]), dtype=np.float64)
    i, j = e.nodes[edges].T
    r = relative_pose(graph.poses[i], graph.poses[j], e.measured[edges])[0]
    gain = R @ _inverse_rest(R, residual_covs(graph, marginals)[at])
    S = gain @ R
    return (gain @ r[..., None])[..., 0], 0.5 * (S + np.swapaxes(S, 1, 2))


def _inverse_rest(R: Array, Q: Array) -> Array:
    """(R - Q)^-1 (k, 3, 3), where an edge that alone ties two parts together leaves nothing."""
    L = np.linalg.inv(np.linalg.cholesky(R))
    rest = L @ (R - Q) @ np.swapaxes(L, 1, 2)
    value, axes = np.linalg.eigh(0.5 * (rest + np.swapaxes(rest, 1, 2)))
    W = np.swapaxes(axes, 1, 2) @ L
    return np.asarray(np.swapaxes(W, 1, 2) @ (W / np.maximum(value, ROUNDING)[..., None]))


def _jacobians(poses: Array, i: Ints, j: Ints) -> tuple[Array, Array]:
    """Those of the relative pose, in the axes of j."""
    there = se2.between(poses[i], poses[j])
    return relative_pose(poses[i], poses[j], there)[1:]


def _carried(J: Array, cov: Array) -> Array:
    return J @ cov @ np.swapaxes(J, 1, 2)
