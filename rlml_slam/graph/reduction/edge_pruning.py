# SPDX-License-Identifier: Apache-2.0
"""Edge and sighting pruning by leverage: effective resistance sparsification of a graph.

The leverage of an edge is the share of the information on the pose of j relative to i that comes
from the edge itself, h = tr(Q W) / 3 with its information W and the covariance Q of its residual
by the whole graph (the effective resistance by which Spielman & Srivastava, "Graph sparsification
by effective resistances", 2011, sample edges). The leverages of all edges sum up to at most the
number of free poses, so that of m edges per pose they are 1 / m in the mean: most of the
information of such an edge is in the others. What is left is what was measured: no covariance
gets smaller. The same holds of the sightings of a pose, h = tr(Q W) / 2; the least are removed.

By leverage alone, the edges that stay would be distributed the more randomly the longer new ones
come in, and the factor of such a graph is nearly full. There, an edge to a pose with many
neighbours costs little, for that pose separates the others anyway: so the leverage of an edge
counts times the square of the number of neighbours of the busier one of its poses. By the number
itself the factor still grew, by 8 % in an hour of driving in one hall; by its square it does not.
Some that are removed have more than the mean leverage for that; none has more than MAX_LEVERAGE.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factors import chi2, pose_landmark
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.reduction.marginalization import edge_weights, robust_weights
from rlml_slam.graph.robust.relative_covariance import residual_covs
from rlml_slam.se2 import Array

# Maximum leverage, in any direction, of an edge that is removed, and of all removed at a time
# together. The edges of a cut sum up to one or more: so the graph stays in one piece.
MAX_LEVERAGE = 0.5


def prune_edges(graph: Graph, allowed: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    """Disable ``allowed`` (e,) edges until ``most`` are left; their indices (k,).

    More are left where too many would be removed at a time. The estimate is to be the optimum.
    """
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    if len(use) <= most:
        return use[:0]
    nodes = e.nodes[use]
    neighbours = np.bincount(np.unique(np.sort(nodes), axis=0).ravel())
    busier = neighbours[nodes].max(axis=1)
    removed = use[_least(leverages(graph), allowed[use], len(use) - most, busier**2)]
    e.enabled[removed] = False
    return removed


def prune_sightings(solver: OnlineSolver, pose: int, most: int) -> NDArray[np.int64]:
    """Disable sightings of one pose until ``most`` are left; covariances from the clique tree."""
    s = solver.graph.sightings
    use = np.flatnonzero((s.nodes[:, 0] == pose) & s.enabled)
    if len(use) <= most:
        return use[:0]
    h = sighting_leverages(solver, pose, use)
    removed = use[_least(h, np.ones(len(use), dtype=np.bool_), len(use) - most)]
    s.enabled[removed] = False
    return removed


def _least(
    h: Array, allowed: NDArray[np.bool_], num: int, times: NDArray[np.int64] | int = 1
) -> NDArray[np.int64]:
    """Indices of up to ``num`` ``allowed`` of the leverages (k, d, d), the least first.

    Each counts so many ``times`` (k,).
    """
    total, largest = np.trace(h, axis1=1, axis2=2), np.linalg.eigvals(h).real.max(axis=1)
    order = np.argsort(total * times, kind='stable')
    order = order[allowed[order] & (largest[order] < MAX_LEVERAGE)]
    least: NDArray[np.int64] = order[np.cumsum(total[order]) < MAX_LEVERAGE * h.shape[1]][:num]
    return least


def leverages(graph: Graph) -> Array:
    """Q W (k, 3, 3) of all enabled edges, in their order; robust weights count."""
    use = np.flatnonzero(graph.edges.enabled)
    Q, W = residual_covs(graph, Marginals(graph)), graph.edges.information[use]
    return Q @ W * edge_weights(graph, use)[:, None, None]


def sighting_leverages(solver: OnlineSolver, pose: int, sightings: NDArray[np.int64]) -> Array:
    """Q W (k, 2, 2) of enabled ``sightings`` (k,), all from one ``pose``; robust weights count."""
    graph, s = solver.graph, solver.graph.sightings
    seen, information = s.nodes[sightings, 1], s.information[sightings]
    who, at = np.unique(seen, return_inverse=True)
    joint = solver.joint([pose], who)
    residual, J_x, J_m = pose_landmark(
        graph.poses[np.full(len(seen), pose)],
        graph.landmarks[seen],
        s.measured[sightings],
        s.kinds[sightings],
    )
    J = np.concatenate([J_x, J_m], axis=2)
    rows = np.concatenate(
        [np.tile(np.arange(3), (len(at), 1)), 3 + 2 * at[:, None] + np.arange(2)], axis=1
    )
    Q = J @ joint[rows[:, :, None], rows[:, None, :]] @ np.swapaxes(J, 1, 2)
    w = robust_weights(graph, s.kinds[sightings], chi2(residual, information))
    out: Array = Q @ information * w[:, None, None]
    return out
