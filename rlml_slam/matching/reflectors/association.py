# SPDX-License-Identifier: Apache-2.0
"""Which detection is which reflector: gated nearest neighbour, joint compatibility in doubt.

Everything is in Mahalanobis distance with the joint covariance of the pose and the reflectors, so
errors that they share (a turned robot, a shifted map) do not count twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.special import gammaincinv

from rlml_slam.matching.reflectors import association_status
from rlml_slam.matching.reflectors.innovations import joint_distance2, pairwise
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections

MAX_NODES = 400  # of the joint compatibility search: bounds its time, never reached in the hall
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Believed:
    """Reflectors as believed; ``cov`` (3 + 2m, 3 + 2m) is joint, with the pose first.

    ``pose`` (3,), ``points`` (m, 2), ``ids`` (m,). ``recent`` (m,): seen so shortly ago that what
    is there now is the same one; where it is given, any other anonymous match must be sure.
    ``spread2`` (m,) [m²] is variance per axis that every detection of a reflector has besides.
    """

    pose: Array
    points: Array
    ids: NDArray[np.int64]
    cov: Array
    recent: NDArray[np.bool_] | None = None
    spread2: Array | None = None


@dataclass(frozen=True)
class Association:
    """``match`` (k,) indexes the believed reflectors, -1 for none; ``status`` (k,) of Status.

    ``distance2`` (k,) is the squared Mahalanobis distance to the match, NaN without one.
    """

    match: NDArray[np.int64]
    status: NDArray[np.int64]
    distance2: Array


def gate(probability: float, dof: int = 2) -> float:
    """Squared Mahalanobis distance that holds ``probability`` of the true matches."""
    # scipy.stats would say the same after half a second of import
    return float(2.0 * gammaincinv(0.5 * dof, probability))


class Associator:
    """Association with the thresholds of one parameter set."""

    def __init__(self, params: Reflector) -> None:
        p = params
        self._limits = association_status.Limits(
            gate(p.gate),
            gate(p.new_gate),
            p.min_separation,
            p.separability_sigma,
            p.unmapped_density,
            p.match_probability,
        )
        self._joint = [gate(p.gate, 2 * k) for k in range(1, 65)]

    def associate(self, detections: Detections, believed: Believed) -> Association:
        """Match detections (k) in the base frame to the believed reflectors (m)."""
        pose, points, cov, seen, noise = map(
            np.ascontiguousarray,
            (believed.pose, believed.points, believed.cov, detections.points, detections.cov),
        )
        m, ids, recent = len(points), detections.ids, believed.recent
        spread2 = np.zeros(m) if believed.spread2 is None else believed.spread2
        nu, d2, log_det = pairwise(pose, points, cov, spread2, seen, noise)
        compatible, rows, cols, alone = association_status.compatible_pairs(
            ids, believed.ids, d2, self._limits
        )

        def joint2(rows: Indices, cols: Indices) -> float:
            return joint_distance2(pose, points, cov, nu, noise, rows, cols)

        if not alone:
            rows, cols = _nearest(d2 + log_det - log_det.min(), compatible)
        if len(rows) > 1 and (not alone or joint2(rows, cols) > self._joint_gate(len(rows))):
            rows, cols = self._jointly(d2, compatible, joint2)
        is_recent = np.zeros(m, np.bool_) if recent is None else recent
        known = association_status.Known(points, believed.ids, is_recent, recent is not None)
        pairing = association_status.Pairing(d2, log_det, compatible, rows, cols)
        return Association(
            *association_status.judge(
                pose, known, association_status.Seen(seen, noise, ids), pairing, self._limits
            )
        )

    def _joint_gate(self, matches: int) -> float:
        return self._joint[min(matches, len(self._joint)) - 1]

    def doubles(self, detections: Detections, match: Indices) -> Indices:
        """(k,): the match of a detection too near to an anonymous unmatched one, or -1."""
        out = np.full(len(detections), -1, dtype=np.int64)
        matched = np.flatnonzero(match >= 0)
        unmatched = np.flatnonzero((match < 0) & (detections.ids == ANONYMOUS))
        if not len(matched) or not len(unmatched):
            return out
        limit = association_status.separable(detections.cov, detections.ids, self._limits)
        for k in unmatched:
            gap = np.linalg.norm(detections.points[matched] - detections.points[k], axis=-1)
            near = int(np.argmin(gap))
            if gap[near] < limit[k]:
                out[k] = matched[near]
        return out

    def _jointly(
        self, d2: Array, compatible: NDArray[np.bool_], joint2: Callable[[Indices, Indices], float]
    ) -> tuple[Indices, Indices]:
        """Joint compatibility branch and bound (Neira, Tardos 2001): most matches, then near.

        ``joint2`` is the squared Mahalanobis distance of a whole hypothesis.
        """
        order = [int(i) for i in np.argsort(compatible.sum(axis=1), kind='stable')]
        order = [i for i in order if compatible[i].any()]
        best: tuple[int, float, list[int], list[int]] = (0, 0.0, [], [])
        nodes = 0

        def descend(level: int, rows: list[int], cols: list[int], cost: float) -> None:
            nonlocal best, nodes
            if (len(rows), -cost) > (best[0], -best[1]):
                best = (len(rows), cost, rows.copy(), cols.copy())
            if level == len(order) or nodes >= MAX_NODES:
                return
            if len(rows) + len(order) - level < best[0]:
                return
            i = order[level]
            for j in np.argsort(d2[i], kind='stable'):
                if not compatible[i, j] or int(j) in cols:
                    continue
                nodes += 1
                r, c = [*rows, i], [*cols, int(j)]
                joint = joint2(np.array(r), np.array(c))
                if joint <= self._joint_gate(len(r)):
                    descend(level + 1, r, c, joint)
            descend(level + 1, rows, cols, cost)

        descend(0, [], [], 0.0)
        return np.array(best[2], dtype=np.int64), np.array(best[3], dtype=np.int64)


def _nearest(cost: Array, compatible: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """The one-to-one assignment of least cost inside the gates, most matches first."""
    some, known = np.flatnonzero(compatible.any(axis=1)), np.flatnonzero(compatible.any(axis=0))
    cost, fits = cost[np.ix_(some, known)], compatible[np.ix_(some, known)]
    # scipy.optimize does the same for 9 MB more; weights of zero would be no edges here
    weights = np.where(fits, 1.0 + cost - cost.min(initial=np.inf, where=fits), 1e6)
    rows, cols = min_weight_full_bipartite_matching(csr_array(weights))
    rows, cols = some[rows], known[cols]
    keep = compatible[rows, cols]
    return rows[keep], cols[keep]
