# SPDX-License-Identifier: Apache-2.0
"""One pose leaves the graph, and what it held together is told by edges between its neighbours.

The factors of a pose and its neighbours form a star. Marginalised, a star is a clique; its
Chow-Liu tree, which keeps as much of the information as any tree can (Kretzschmar & Stachniss,
"Information-theoretic compression of pose graphs", IJRR 31 (2012)), ties to one another those that
know their relative pose best: all of them to the one that was nearest to the centre. Marginals
of relative poses along the tree are exact; what is lost is that the errors of its edges have
the error of that one tie in common.
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
LEAST = 1e-6  # weight of an edge that a loss has switched off: it still must have a covariance


class Ties(NamedTuple):
    """Poses T (..., 3) seen from other poses, and ``cov`` (..., 3, 3) of their coordinates."""

    T: Array
    cov: Array

    def inverse(self) -> Ties:
        """Seen from the other end."""
        J, _ = se2.between_jacobians(self.T, np.zeros_like(self.T))
        return Ties(se2.inverse(self.T), J @ self.cov @ np.swapaxes(J, -1, -2))

    def then(self, other: Ties) -> Ties:
        """From a to b, and independently of that from b to c: from a to c."""
        J_a, J_b = se2.compose_jacobians(self.T, other.T)
        cov = J_a @ self.cov @ np.swapaxes(J_a, -1, -2) + J_b @ other.cov @ np.swapaxes(
            J_b, -1, -2
        )
        return Ties(se2.compose(self.T, other.T), cov)


class Elimination(NamedTuple):
    """A pose that left: ``onto`` the neighbour that it was tied to best, ``tie`` from there.

    ``edges`` maps each edge that was disabled to the one that tells of it now, -1 for those to
    ``onto``.
    """

    onto: int
    tie: Ties
    edges: dict[int, int]


def eliminate(graph: Graph, pose: int, floor2: Array) -> Elimination:
    """Disable the edges of ``pose`` and tie its neighbours to one another.

    Its sightings are the caller's to move. Robust weights at the current estimate count; fused
    edges are no better than ``floor2`` (3,). Raises SolverError for a pose without edges, or where
    its neighbours cannot be tied by numbers of this size; then the graph is as it was.
    """
    try:
        return _eliminated(graph, pose, floor2)
    except np.linalg.LinAlgError as e:
        raise SolverError(f'pose {pose} cannot be eliminated: {e}') from e


def _eliminated(graph: Graph, pose: int, floor2: Array) -> Elimination:
    edges = graph.edges
    touching = np.flatnonzero((edges.nodes == pose).any(-1) & edges.enabled)
    if not len(touching):
        raise SolverError(f'pose {pose} has no edge')
    ties, other = _seen_from(graph, pose, touching)
    who, at = np.unique(other, return_inverse=True)
    star = fused(ties, at, len(who), floor2)
    kinds = np.zeros(len(who), dtype=np.int64)
    np.maximum.at(kinds, at, edges.kinds[touching])  # that of the least trusted one
    hub = int(np.argmin(np.linalg.slogdet(star.cov)[1]))
    onto, back = int(who[hub]), Ties(star.T[hub], star.cov[hub]).inverse()
    rest = np.delete(np.arange(len(who)), hub)
    leaves = back.then(Ties(star.T[rest], star.cov[rest]))
    kinds = np.maximum(kinds[rest], kinds[hub])
    index, replaced, of = _tie(graph, onto, who[rest], leaves, kinds, floor2)
    edges.enabled[touching] = False
    told = np.full(len(who), -1)
    told[rest] = index
    now = dict(zip(touching.tolist(), told[at].tolist(), strict=True))
    now.update(zip(replaced.tolist(), index[of].tolist(), strict=True))
    return Elimination(onto, back, now)


def _seen_from(
    graph: Graph, pose: int, edges: NDArray[np.int64]
) -> tuple[Ties, NDArray[np.int64]]:
    """What ``edges`` (k,) of a pose say of the poses at their other ends, and which these are."""
    e, nodes = graph.edges, graph.edges.nodes[edges]
    T = e.measured[edges]
    B = np.zeros((len(edges), 3, 3))
    B[:, :2, :2], B[:, 2, 2] = se2.rotation(T[:, 2]), 1.0  # information: second pose's axes
    W = e.information[edges] * _weights(graph, edges)[:, None, None]
    ties = Ties(T, B @ np.linalg.inv(W) @ np.swapaxes(B, 1, 2))
    to = nodes[:, 1] == pose
    back = ties.inverse()
    there = Ties(
        np.where(to[:, None], back.T, ties.T), np.where(to[:, None, None], back.cov, ties.cov)
    )
    return there, np.where(to, nodes[:, 0], nodes[:, 1])


def _weights(graph: Graph, edges: NDArray[np.int64]) -> Array:
    e = graph.edges
    i, j = e.nodes[edges].T
    residual, _, _ = relative_pose(graph.poses[i], graph.poses[j], e.measured[edges])
    s = chi2(residual, e.information[edges])
    losses = graph.losses.in_order()
    of = [losses[code] for code in e.kinds[edges].tolist()]
    w = [loss(int(one.kind), one.scale, v)[1] for one, v in zip(of, s.tolist(), strict=True)]
    return np.maximum(w, LEAST)


def _tie(
    graph: Graph,
    i: int,
    others: NDArray[np.int64],
    ties: Ties,
    kinds: NDArray[np.int64],
    floor2: Array,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Add edges from pose i to ``others`` (n,), one each with those of its kind that are there.

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
    both = Ties(
        np.concatenate([ties.T, there.T[same]]), np.concatenate([ties.cov, there.cov[same]])
    )
    new = fused(both, np.concatenate([np.arange(len(others)), of]), len(others), floor2)
    nodes = np.stack([np.full(len(others), i), others], -1)
    information = relative_information(new.T, new.cov)
    index = graph.add_edges([KINDS[k] for k in kinds.tolist()], nodes, new.T, information)
    e.enabled[replaced] = False
    return index, replaced, of


def fused(ties: Ties, at: NDArray[np.int64], n: int, floor2: Array) -> Ties:
    """One tie for each of n ends, of all those that lead ``at`` it."""
    W = np.linalg.inv(ties.cov)
    first = np.zeros(n, dtype=np.int64)
    first[at[::-1]] = np.arange(len(at))[::-1]
    d = ties.T - ties.T[first][at]
    d[:, 2] = se2.wrap(d[:, 2])
    S, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(S, at, W)
    np.add.at(b, at, (W @ d[..., None])[..., 0])
    C = np.asarray(np.linalg.inv(S), dtype=np.float64)
    T = ties.T[first] + (C @ b[..., None])[..., 0]
    T[:, 2] = se2.wrap(T[:, 2])
    return Ties(T, limited(C, floor2, ties.cov, at))


def limited(cov: Array, floor2: Array, of: Array, at: NDArray[np.int64]) -> Array:
    """Covariances (n, d, d) of fused estimates, nowhere better than ``floor2`` (d,).

    Many of them do not average out what they have in common. Where one of those ``of`` (k, d, d)
    that an estimate is made of, ``at`` (k,), is better already, that is the limit.
    """
    scale = np.sqrt(np.outer(floor2, floor2))
    best = np.full(len(cov), 1.0)
    np.minimum.at(best, at, np.linalg.eigvalsh(of / scale)[:, 0])
    values, vectors = np.linalg.eigh(cov / scale)
    values = np.maximum(values, best[:, None])
    out: Array = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2) * scale
    return 0.5 * (out + np.swapaxes(out, 1, 2))
