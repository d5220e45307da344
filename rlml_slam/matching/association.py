# SPDX-License-Identifier: Apache-2.0
"""Which detection is which reflector: gated nearest neighbour, joint compatibility in doubt.

Everything is in Mahalanobis distance with the joint covariance of the pose and the reflectors, so
errors that they share (a turned robot, a shifted map) do not count twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from rlml_slam import se2
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections, Status

WIDE = math.log(16.0)  # of the area of an ellipse, squared: each axis twice the detection's
MAX_NODES = 400  # of the joint compatibility search: bounds its time, never reached in the hall


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


def predict(pose: Array, points: Array) -> tuple[Array, Array, Array]:
    """Expected detections z = R(theta)^T (m - p) of eq. 1 and their Jacobians.

    Returns z (m, 2), dz/dpose (m, 2, 3) and dz/dm (2, 2), which is the same for all.
    """
    Rt = se2.rotation(pose[2]).T
    z = (points - pose[:2]) @ Rt.T
    J = np.empty((len(points), 2, 3))
    J[:, :, :2] = -Rt
    J[:, 0, 2] = z[:, 1]
    J[:, 1, 2] = -z[:, 0]
    return z, J, Rt


def gate(probability: float, dof: int = 2) -> float:
    """Squared Mahalanobis distance that holds ``probability`` of the true matches."""
    # scipy.stats would say the same after half a second of import
    return float(2.0 * gammaincinv(0.5 * dof, probability))


class Associator:
    """Association with the thresholds of one parameter set."""

    def __init__(self, params: Reflector) -> None:
        self._p = params
        self._gate = gate(params.gate)
        self._new_gate = gate(params.new_gate)
        self._joint = [gate(params.gate, 2 * k) for k in range(1, 65)]

    def associate(self, detections: Detections, believed: Believed) -> Association:
        """Match detections (k) in the base frame to the believed reflectors (m)."""
        k, m = len(detections), len(believed.points)
        match = np.full(k, -1, dtype=np.int64)
        status = np.full(k, Status.NEW, dtype=np.int64)
        distance2 = np.full(k, np.nan)
        if k == 0 or m == 0:
            if believed.recent is not None:
                self._keep_apart(detections, status)
            return Association(match, status, distance2)
        z, J, Rt = predict(believed.pose, believed.points)
        nu = detections.points[:, None, :] - z[None, :, :]
        S = _innovation_cov(believed.cov, J, Rt)[None] + detections.cov[:, None]
        if believed.spread2 is not None:
            S = S + believed.spread2[:, None, None] * np.eye(2)
        d2 = _mahalanobis2(nu, S)
        log_det = np.log(S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0])
        compatible = self._compatible(detections, believed, d2)
        rows, cols = self._nearest(d2 + log_det - log_det.min(), compatible)
        if self._in_doubt(rows, cols, nu, compatible, believed, J, Rt, detections):
            rows, cols = self._jointly(nu, d2, compatible, believed, J, Rt, detections)
        anonymous = detections.ids == ANONYMOUS
        wide = np.zeros(k, dtype=np.bool_)
        recent = believed.recent
        if recent is not None:
            wide = anonymous & self._is_wide(log_det, d2 + log_det, detections.cov)
            wide &= ~self._inseparable(detections, believed.points[recent], believed.pose)
            wide &= ~(d2[:, recent] < self._new_gate).any(axis=1)
            odds = self._odds(rows, cols, d2, log_det)
            sure = ~anonymous[rows] | recent[cols] | (odds > self._p.sure)
            rows, cols = rows[sure], cols[sure]
        match[rows] = cols
        status[rows] = Status.USED
        distance2[rows] = d2[rows, cols]
        # what lies near a known reflector without matching it is neither used nor new
        near = (d2.min(axis=1) < self._new_gate) | self._inseparable(
            detections, believed.points, believed.pose
        )
        known = np.isin(detections.ids, believed.ids) & (detections.ids != ANONYMOUS)
        unknown = (detections.ids != ANONYMOUS) & ~known
        gated = (match < 0) & (near | known) & ~unknown
        status[gated] = np.where(compatible[gated].any(axis=1), Status.AMBIGUOUS, Status.GATED)
        status[gated & wide] = Status.DOUBTFUL
        if recent is not None:
            self._keep_apart(detections, status)
        return Association(match, status, distance2)

    def _odds(
        self, rows: NDArray[np.int64], cols: NDArray[np.int64], d2: Array, log_det: Array
    ) -> Array:
        """Probability (q,) of each match, against all other reflectors and one not yet mapped.

        The latter stands anywhere with ``density``, so a match counts for nothing where the pose
        is so uncertain that an unknown reflector would be expected within its ellipse as well.
        One wrong match costs more than many that wait.
        """
        peak = np.exp(-0.5 * log_det[rows]) / (2.0 * math.pi)
        likelihood = peak * np.exp(-0.5 * d2[rows])
        i = np.arange(len(rows))
        against_others = likelihood[i, cols] / likelihood.sum(axis=1)
        against_unknown = peak[i, cols] / (peak[i, cols] + self._p.density)
        odds: Array = against_others * against_unknown
        return odds

    @staticmethod
    def _is_wide(log_det: Array, cost: Array, cov: Array) -> NDArray[np.bool_]:
        """(k,): the likeliest reflector's place is less certain than the detection itself."""
        likeliest = np.argmin(cost, axis=1)
        own = np.log(np.linalg.det(cov))
        wide: NDArray[np.bool_] = log_det[np.arange(len(cov)), likeliest] > own + WIDE
        return wide

    def _compatible(
        self, detections: Detections, believed: Believed, d2: Array
    ) -> NDArray[np.bool_]:
        """(k, m): inside the gate and not of different identity; an id needs no gate but sense."""
        a, b = detections.ids[:, None], believed.ids[None, :]
        same = (a == b) & (a != ANONYMOUS)
        anonymous = (a == ANONYMOUS) | (b == ANONYMOUS)
        ok: NDArray[np.bool_] = (same & (d2 < self._new_gate)) | (anonymous & (d2 < self._gate))
        return ok

    def doubles(self, detections: Detections, match: NDArray[np.int64]) -> NDArray[np.int64]:
        """(k,): the match that an anonymous unmatched detection cannot be told from, or -1."""
        out = np.full(len(detections), -1, dtype=np.int64)
        matched = np.flatnonzero(match >= 0)
        if not len(matched):
            return out
        limit = self._separable(detections)
        for k in np.flatnonzero((match < 0) & (detections.ids == ANONYMOUS)):
            gap = np.linalg.norm(detections.points[matched] - detections.points[k], axis=-1)
            near = int(np.argmin(gap))
            if gap[near] < limit[k]:
                out[k] = matched[near]
        return out

    def _inseparable(
        self, detections: Detections, points: Array, pose: Array
    ) -> NDArray[np.bool_]:
        """(k,): closer to a known reflector than two reflectors can be told apart.

        That is ``min_separation``, and never less than what the detection's own noise allows: of
        two markers within it, an anonymous detection can be of either, and both count as one.
        """
        p = se2.transform(pose, detections.points)
        gap = np.linalg.norm(p[:, None] - points[None], axis=-1)
        near: NDArray[np.bool_] = (gap < self._separable(detections)[:, None]).any(axis=1)
        return near

    def _separable(self, detections: Detections) -> Array:
        """Distance (k,) from which on two reflectors can be told apart."""
        noise = np.sqrt(np.linalg.eigvalsh(detections.cov)[:, -1])
        blur = np.where(detections.ids == ANONYMOUS, self._p.blur * noise, 0.0)
        return np.maximum(self._p.min_separation, blur)

    def _keep_apart(self, detections: Detections, status: NDArray[np.int64]) -> None:
        """Of unknown detections that cannot be told apart, only the first begins a reflector."""
        fresh = np.flatnonzero(np.isin(status, (Status.NEW, Status.DOUBTFUL)))
        limit = self._separable(detections)
        for i, k in enumerate(fresh):
            gap = np.linalg.norm(detections.points[fresh[:i]] - detections.points[k], axis=-1)
            begun = status[fresh[:i]] != Status.AMBIGUOUS
            if detections.ids[k] == ANONYMOUS and (begun & (gap < limit[k])).any():
                status[k] = Status.AMBIGUOUS

    @staticmethod
    def _nearest(
        cost: Array, compatible: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The one-to-one assignment of least cost inside the gates, most matches first."""
        finite = np.where(compatible, cost, 1e6)
        rows, cols = linear_sum_assignment(finite)
        keep = compatible[rows, cols]
        return rows[keep], cols[keep]

    def _in_doubt(
        self,
        rows: NDArray[np.int64],
        cols: NDArray[np.int64],
        nu: Array,
        compatible: NDArray[np.bool_],
        believed: Believed,
        J: Array,
        Rt: Array,
        detections: Detections,
    ) -> bool:
        if len(rows) < 2:
            return False
        several = (compatible.sum(axis=1) > 1).any() or (compatible.sum(axis=0) > 1).any()
        if not several and len(rows) == int(compatible.any(axis=1).sum()):
            joint = _joint_distance2(rows, cols, nu, believed, J, Rt, detections.cov)
            return joint > self._joint[min(len(rows), 64) - 1]
        return True

    def _jointly(
        self,
        nu: Array,
        d2: Array,
        compatible: NDArray[np.bool_],
        believed: Believed,
        J: Array,
        Rt: Array,
        detections: Detections,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Joint compatibility branch and bound (Neira, Tardos 2001): most matches, then near."""
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
                joint = _joint_distance2(
                    np.array(r), np.array(c), nu, believed, J, Rt, detections.cov
                )
                if joint <= self._joint[min(len(r), 64) - 1]:
                    descend(level + 1, r, c, joint)
            descend(level + 1, rows, cols, cost)

        descend(0, [], [], 0.0)
        return np.array(best[2], dtype=np.int64), np.array(best[3], dtype=np.int64)


def _innovation_cov(cov: Array, J: Array, Rt: Array) -> Array:
    """H P H^T (m, 2, 2) of every reflector, from the joint covariance."""
    m = len(J)
    Ppp = cov[:3, :3]
    Ppm = cov[:3, 3:].reshape(3, m, 2).transpose(1, 0, 2)
    k = np.arange(m)
    Pmm = cov[3:, 3:].reshape(m, 2, m, 2)[k, :, k, :]
    cross = J @ Ppm @ Rt.T
    out: Array = (
        J @ Ppp @ J.transpose(0, 2, 1) + cross + cross.transpose(0, 2, 1) + Rt @ Pmm @ Rt.T
    )
    return out


def _mahalanobis2(nu: Array, S: Array) -> Array:
    """nu^T S^-1 nu over leading dimensions, 2 x 2 in closed form."""
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    a, b = nu[..., 0], nu[..., 1]
    out: Array = (
        S[..., 1, 1] * a * a - (S[..., 0, 1] + S[..., 1, 0]) * a * b + S[..., 0, 0] * b * b
    ) / det
    return out


def _joint_distance2(
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
    nu: Array,
    believed: Believed,
    J: Array,
    Rt: Array,
    cov: Array,
) -> float:
    """Squared Mahalanobis distance of a whole hypothesis (rows[i] is cols[i])."""
    q = len(rows)
    blocks = np.zeros((q, 2, 3 + 2 * q))
    k = np.arange(q)
    blocks[:, :, :3] = J[cols]
    blocks[k, :, 3 + 2 * k] = Rt[:, 0]
    blocks[k, :, 4 + 2 * k] = Rt[:, 1]
    H = blocks.reshape(2 * q, 3 + 2 * q)
    columns = np.concatenate([[0, 1, 2], np.stack([3 + 2 * cols, 4 + 2 * cols], 1).ravel()])
    S = H @ believed.cov[np.ix_(columns, columns)] @ H.T
    S.reshape(q, 2, q, 2)[k, :, k, :] += cov[rows]
    v = nu[rows, cols].ravel()
    return float(v @ np.linalg.solve(S, v))
