# SPDX-License-Identifier: Apache-2.0
"""Marginalization of a pose: its edges are replaced by the Chow-Liu tree of its neighbours.

The edges of a pose form a star. Marginalized, a star is a clique of its neighbours; the Chow-Liu
tree of the clique, which keeps as much information as any tree can (Kretzschmar & Stachniss,
"Information-theoretic compression of pose graphs", IJRR 31 (2012)), joins those whose relative
poses are known best: all of them to the hub, the one with the most certain edge to the pose.
Marginals of relative poses along the tree are exact; what is lost is that the errors of its edges
have the error of the hub's edge in common.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.model.factors import chi2, relative_information, relative_pose
from rlml_slam.graph.model.graph import EDGE_KINDS, Graph
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.se2 import Array

KINDS = {int(code): kind for kind, code in EDGE_KINDS.items()}
MIN_WEIGHT = 1e-6  # of an edge that a loss has switched off, whose covariance must stay finite


class RelativePoses(NamedTuple):
    """Relative poses T (..., 3) with the covariances ``cov`` (..., 3, 3) of their coordinates."""

    T: Array
    cov: Array

    def inverse(self) -> RelativePoses:
        """T^-1, seen from the other end."""
        J, _ = se2.between_jacobians(self.T, np.zeros_like(self.T))
        return RelativePoses(se2.inverse(self.T), J @ self.cov @ np.swapaxes(J, -1, -2))

    def compose(self, other: RelativePoses) -> RelativePoses:
        """From a to b, and independently of that from b to c: from a to c."""
        J_a, J_b = se2.compose_jacobians(self.T, other.T)
        cov = J_a @ self.cov @ np.swapaxes(J_a, -1, -2) + J_b @ other.cov @ np.swapaxes(
            J_b, -1, -2
        )
        return RelativePoses(se2.compose(self.T, other.T), cov)


class MarginalizedPose(NamedTuple):
    """A marginalized pose: the neighbour ``hub`` and its pose ``from_hub``, as seen from there.

    ``edges`` maps each edge that was disabled to its replacement, -1 for those to the hub.
    """

    hub: int
    from_hub: RelativePoses
    edges: dict[int, int]


def marginalize_pose(graph: Graph, pose: int, floor2: Array) -> MarginalizedPose:
    """Disable the edges of ``pose`` and add edges between its neighbours.

    The caller moves its sightings. Robust weights at the current estimate count; no variance of a
    fused edge is below ``floor2`` (3,). Raises SolverError for a pose without edges, or where a
    covariance is numerically singular; then the graph is unchanged.
    """
    try:
        return _marginalized(graph, pose, floor2)
    except np.linalg.LinAlgError as e:
        raise SolverError(f'pose {pose} cannot be marginalized: {e}') from e


def _marginalized(graph: Graph, pose: int, floor2: Array) -> MarginalizedPose:
    edges = graph.edges
    touching = np.flatnonzero((edges.nodes == pose).any(-1) & edges.enabled)
    if not len(touching):
        raise SolverError(f'pose {pose} has no edge')
    relative, other = _seen_from(graph, pose, touching)
    who, at = np.unique(other, return_inverse=True)
    star = fuse(relative, at, len(who), floor2)
    kinds = np.zeros(len(who), dtype=np.int64)
    np.maximum.at(kinds, at, edges.kinds[touching])  # that of the least trusted one
    hub = int(np.argmin(np.linalg.slogdet(star.cov)[1]))
    onto, back = int(who[hub]), RelativePoses(star.T[hub], star.cov[hub]).inverse()
    rest = np.delete(np.arange(len(who)), hub)
    leaves = back.compose(RelativePoses(star.T[rest], star.cov[rest]))
    kinds = np.maximum(kinds[rest], kinds[hub])
    index, replaced, of = _add_star(graph, onto, who[rest], leaves, kinds, floor2)
    edges.enabled[touching] = False
    replacement = np.full(len(who), -1)
    replacement[rest] = index
    now = dict(zip(touching.tolist(), replacement[at].tolist(), strict=True))
    now.update(zip(replaced.tolist(), index[of].tolist(), strict=True))
    return MarginalizedPose(onto, back, now)


def _seen_from(
    graph: Graph, pose: int, edges: NDArray[np.int64]
) -> tuple[RelativePoses, NDArray[np.int64]]:
    """The poses at the other ends of ``edges`` (k,), seen from ``pose``, and which these are."""
    e, nodes = graph.edges, graph.edges.nodes[edges]
    T = e.measured[edges]
    B = np.zeros((len(edges), 3, 3))
    B[:, :2, :2], B[:, 2, 2] = se2.rotation(T[:, 2]), 1.0  # information: second pose's axes
    w = np.maximum(edge_weights(graph, edges), MIN_WEIGHT)
    W = e.information[edges] * w[:, None, None]
    relative = RelativePoses(T, B @ np.linalg.inv(W) @ np.swapaxes(B, 1, 2))
    to = nodes[:, 1] == pose
    back = relative.inverse()
    there = RelativePoses(
        np.where(to[:, None], back.T, relative.T),
        np.where(to[:, None, None], back.cov, relative.cov),
    )
    return there, np.where(to, nodes[:, 0], nodes[:, 1])


def edge_weights(graph: Graph, edges: NDArray[np.int64]) -> Array:
    """Robust weights of ``edges`` (k,) at the current estimate."""
    e = graph.edges
    i, j = e.nodes[edges].T
    residual = relative_pose(graph.poses[i], graph.poses[j], e.measured[edges])[0]
    return robust_weights(graph, e.kinds[edges], chi2(residual, e.information[edges]))


def robust_weights(graph: Graph, kinds: NDArray[np.int64], s: Array) -> Array:
    """Robust weights of factors (k,) with squared norms ``s`` (k,)."""
    losses = graph.losses.in_order()
    of = [losses[code] for code in kinds.tolist()]
    return np.array(
        [loss(int(one.kind), one.scale, v)[1] for one, v in zip(of, s.tolist(), strict=True)]
    )


def _add_star(
    graph: Graph,
    i: int,
    others: NDArray[np.int64],
    relative: RelativePoses,
    kinds: NDArray[np.int64],
    floor2: Array,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Add edges from pose i to ``others`` (n,), each fused with parallel edges of its kind.

    Their indices (n,), those of the edges replaced (r,), and by which of the n (r,).
    """
    if not len(others):
        none = np.zeros(0, dtype=np.int64)
        return none, none, none
    e = graph.edges
    known = np.flatnonzero((e.nodes == i).any(-1) & e.enabled)
    there, ends = _seen_from(graph, i, known)
    of = np.minimum(np.searchsorted(others, ends), len(others) - 1)
    same = (others[of] == ends) & (kinds[of] == e.kinds[known])
    replaced, of = known[same], of[same]
    both = RelativePoses(
        np.concatenate([relative.T, there.T[same]]),
        np.concatenate([relative.cov, there.cov[same]]),
    )
    new = fuse(both, np.concatenate([np.arange(len(others)), of]), len(others), floor2)
    nodes = np.stack([np.full(len(others), i), others], -1)
    information = relative_information(new.T, new.cov)
    index = graph.add_edges([KINDS[k] for k in kinds.tolist()], nodes, new.T, information)
    e.enabled[replaced] = False
    return index, replaced, of


def fuse(relative: RelativePoses, at: NDArray[np.int64], n: int, floor2: Array) -> RelativePoses:
    """Information-weighted mean (n, 3) of the relative poses (k,) with the same index ``at``."""
    W = np.linalg.inv(relative.cov)
    first = np.zeros(n, dtype=np.int64)
    first[at[::-1]] = np.arange(len(at))[::-1]
    d = relative.T - relative.T[first][at]
    d[:, 2] = se2.wrap(d[:, 2])
    S, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(S, at, W)
    np.add.at(b, at, (W @ d[..., None])[..., 0])
    C = np.asarray(np.linalg.inv(S), dtype=np.float64)
    T = relative.T[first] + (C @ b[..., None])[..., 0]
    T[:, 2] = se2.wrap(T[:, 2])
    return RelativePoses(T, floored_covariance(C, floor2, relative.cov, at))


def floored_covariance(cov: Array, floor2: Array, of: Array, at: NDArray[np.int64]) -> Array:
    """Covariances (n, d, d) of fused estimates, with no variance below ``floor2`` (d,).

    Averaging does not remove errors that measurements have in common. Where one of those fused,
    ``of`` (k, d, d) with index ``at`` (k,), is more certain already, its variance is the limit.
    """
    scale = np.sqrt(np.outer(floor2, floor2))
    best = np.full(len(cov), 1.0)
    np.minimum.at(best, at, np.linalg.eigvalsh(of / scale)[:, 0])
    values, vectors = np.linalg.eigh(cov / scale)
    values = np.maximum(values, best[:, None])
    out: Array = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2) * scale
    return 0.5 * (out + np.swapaxes(out, 1, 2))
