# SPDX-License-Identifier: Apache-2.0
"""Association of all detections of a run with reflectors, whose number is estimated with it.

A detection belongs to one reflector or to none (multi_hypothesis.OUTLIER); a reflector is
detected once in a frame. The number of reflectors maximizes the likelihood of all associations
less two costs. One is that of each position: a prior of ``reflector.unmapped_density`` against the
covariance of its detections (Laplace), which is the penalty of the BIC with its constants. The
other is the entropy of associations between two close reflectors (integrated completed likelihood:
Biernacki, Celeux, Govaert 2000). So one cluster of detections is one reflector however many they
are, and two reflectors seen in one frame are two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.multi_hypothesis import OUTLIER
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections

NEAREST = 6  # reflectors that a detection may be of
MEDIAN = 2.0 * math.log(2.0)  # of chi-square with 2 degrees of freedom
HALVINGS = 30  # of the search for the spread
# Of two whose detections have at least this share in the middle third of the way between them, of
# what the thirds beside it have, none stands by itself: a flat cloud has 1, two that are 3.5 sigma
# apart have 0.6, and 0.3 at 4.5 sigma.
VALLEY = 0.5
Indices = NDArray[np.int64]


class ReflectorPoints(NamedTuple):
    """Reflectors at ``points`` (m, 2), map frame, with ``ids`` (m,)."""

    points: Array
    ids: Indices


class Pairs(NamedTuple):
    """Nearest reflectors of each detection, and the gain of each association.

    ``reflector`` (n, NEAREST), -1 where there are fewer; ``gain`` (n, NEAREST) is the log odds
    against none, -inf outside the gate.
    """

    reflector: Indices
    gain: Array


class BatchAssociation:
    """All detections of a run, ``z`` (n, 2) with covariances ``R``, of the frames ``frame_of``."""

    def __init__(self, seen: Sequence[Detections | None], params: Reflector) -> None:
        kept = [(k, d) for k, d in enumerate(seen) if d is not None and len(d)]
        self.frame_of = np.concatenate([np.full(len(d), k) for k, d in kept])
        self.z, self.R = (
            np.concatenate([getattr(d, name) for _, d in kept]) for name in ('points', 'cov')
        )
        self._ids = np.concatenate([d.ids for _, d in kept])
        self._ends = np.cumsum([0 if d is None else len(d) for d in seen])
        self._limit = gate(params.gate)
        self._density = params.unmapped_density
        self._fewest = params.min_sightings
        self._separation = params.min_separation

    @property
    def is_ambiguous(self) -> bool:
        """Whether any detection leaves open which reflector it is of."""
        return bool((self._ids == ANONYMOUS).any())

    def by_frame(self, associations: Indices) -> list[Indices]:
        """The associations (n,) to the detections of each observation."""
        return np.split(associations, self._ends[:-1])

    def associate(
        self, poses: Array, reflectors: ReflectorPoints, extra_variance: float = 0.0
    ) -> tuple[ReflectorPoints, Indices]:
        """Reflectors, and the one (n,) of each detection, -1 for none, for ``poses`` (k, 3).

        ``extra_variance`` [m²] per axis, or a larger one that the residuals show, is added to the
        covariances. All reflectors have detections.
        """
        T = poses[self.frame_of]
        self._points = se2.transform(T, self.z[:, None])[:, 0]
        R = se2.rotation(T[:, 2])
        cov = R @ self.R @ np.swapaxes(R, 1, 2)
        self._cov = cov + max(extra_variance, self._spread2(cov, reflectors)) * np.eye(2)
        self._W = np.linalg.inv(self._cov)
        self._peak = 0.5 * np.linalg.slogdet(self._W)[1] - math.log(2.0 * math.pi) - OUTLIER
        self._reach = np.sqrt(self._limit * np.linalg.eigvalsh(self._cov)[:, 1])
        reflectors = self._with_new(reflectors)
        reflectors = self._needed(reflectors)
        pairs = self._pairs(reflectors)
        return _numbered(reflectors, self._match(pairs))

    def joined(
        self, reflectors: ReflectorPoints, associations: Indices
    ) -> tuple[ReflectorPoints, Indices]:
        """Those nearer than ``reflector.min_separation`` that are one cloud are one reflector.

        Two that stand beside each other are seen together in some look, or there is a gap between
        their detections. What is in many places, never in two at once, and anywhere between them
        is a person, or a detection with more noise than its covariance.
        """
        while (pair := self._of_one(reflectors, associations)) is not None:
            a, b = pair
            associations = np.where(associations == b, a, associations)
            points, ids = reflectors.points.copy(), reflectors.ids.copy()
            points[a] = self._mean(np.flatnonzero(associations == a))
            ids[a] = ids[b] if ids[a] == ANONYMOUS else ids[a]
            reflectors, associations = _numbered(ReflectorPoints(points, ids), associations)
        return reflectors, associations

    def _of_one(
        self, reflectors: ReflectorPoints, associations: Indices
    ) -> tuple[int, int] | None:
        """The nearest two that are one."""
        if not len(reflectors.points):
            return None
        pairs = cKDTree(reflectors.points).query_pairs(self._separation, output_type='ndarray')
        apart = reflectors.points[pairs[:, 1]] - reflectors.points[pairs[:, 0]]
        for k in np.argsort(np.hypot(*apart.T), kind='stable').tolist():
            a, b = pairs[k].tolist()
            of_a, of_b = np.flatnonzero(associations == a), np.flatnonzero(associations == b)
            is_named = (reflectors.ids[pairs[k]] != ANONYMOUS).all()
            if is_named or len(np.intersect1d(self.frame_of[of_a], self.frame_of[of_b])):
                continue
            own = self._points[np.append(of_a, of_b)] - reflectors.points[a]
            along = own @ apart[k] / (apart[k] @ apart[k])
            first, middle, last = np.histogram(along, 3, (0.0, 1.0))[0].tolist()
            if middle >= VALLEY * 0.5 * (first + last):
                return a, b
        return None

    def _spread2(self, cov: Array, reflectors: ReflectorPoints) -> float:
        """Variance per axis [m²] by which detections miss their reflectors beyond their noise.

        With it, half of them are within the median of chi-square: others may be of anything.
        """
        gap, at = cKDTree(reflectors.points).query(self._points)
        near = gap < np.sqrt(self._limit * np.linalg.eigvalsh(cov)[:, 1]) + self._widest(
            reflectors
        )
        nu, cov = (self._points - reflectors.points[at])[near], cov[near]
        if not len(nu):
            return 0.0
        low, high = 0.0, float((nu**2).sum(axis=1).max())
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            d2 = _distance2(nu, np.asarray(np.linalg.inv(cov + middle * np.eye(2))))
            low, high = (middle, high) if np.median(d2) > MEDIAN else (low, middle)
        return high

    @staticmethod
    def _widest(reflectors: ReflectorPoints) -> float:
        """How far off a detection may be and still be nearer to its reflector than to others."""
        if len(reflectors.points) < 2:
            return math.inf
        gaps = cKDTree(reflectors.points).query(reflectors.points, 2)[0][:, 1]
        return 0.5 * float(np.median(gaps))

    def _pairs(self, reflectors: ReflectorPoints) -> Pairs:
        k = min(NEAREST, len(reflectors.points))
        gap, reflector = cKDTree(reflectors.points).query(self._points, range(1, k + 1))
        inside = gap < self._reach[:, None]
        reflector[~inside] = -1
        d2 = _distance2(self._points[:, None] - reflectors.points[reflector], self._W[:, None])
        gain = np.where(inside & (d2 < self._limit), self._peak[:, None] - 0.5 * d2, -np.inf)
        named = self._ids[:, None] != ANONYMOUS
        gain[
            named
            & (reflectors.ids[reflector] != ANONYMOUS)
            & (reflectors.ids[reflector] != self._ids[:, None])
        ] = -np.inf
        return self._by_id(Pairs(reflector, np.where(gain > 0.0, gain, -np.inf)), reflectors)

    def _by_id(self, pairs: Pairs, reflectors: ReflectorPoints) -> Pairs:
        """A detection with the id of a reflector belongs to it, at any distance."""
        order = np.argsort(reflectors.ids, kind='stable')
        at = np.searchsorted(reflectors.ids[order], self._ids)
        at = order[np.minimum(at, len(order) - 1)]
        own = (self._ids != ANONYMOUS) & (reflectors.ids[at] == self._ids)
        pairs.reflector[own], pairs.gain[own] = -1, -np.inf
        pairs.reflector[own, 0], pairs.gain[own, 0] = at[own], self._peak[own]
        return pairs

    def _match(self, pairs: Pairs) -> Indices:
        """The likeliest reflector (n,) of each detection, each once in a look; -1 for none."""
        rows = np.arange(len(pairs.gain))
        best = pairs.gain.argmax(axis=1)
        out = np.where(pairs.gain[rows, best] > 0.0, pairs.reflector[rows, best], -1)
        used = np.flatnonzero(out >= 0)
        seen = np.stack([self.frame_of[used], out[used]])
        _, first, count = np.unique(seen, axis=1, return_inverse=True, return_counts=True)
        # in most looks each has one of its own, and there is nothing to be weighed
        for k in np.unique(self.frame_of[used][count[first.ravel()] > 1]).tolist():
            look = slice(self._ends[k - 1] if k else 0, self._ends[k])
            out[look] = _assigned(pairs.reflector[look], pairs.gain[look])
        return out

    def _with_new(self, reflectors: ReflectorPoints) -> ReflectorPoints:
        """The reflectors and, after them, those that detections of none of them show."""
        left = np.flatnonzero(
            (self._match(self._pairs(reflectors)) < 0) & (self._ids == ANONYMOUS)
        )
        found = [reflectors.points]
        tree = cKDTree(self._points[left])
        # of many in one cloud each is near all others: their lists are made one by one
        near = tree.query_ball_point(self._points[left], self._reach[left], return_length=True)
        free = np.ones(len(left), dtype=np.bool_)
        for k in np.argsort(-near, kind='stable').tolist():
            if not free[k]:
                continue
            group = np.array(tree.query_ball_point(self._points[left[k]], self._reach[left[k]]))
            group = left[group[free[group]]]
            point = self._mean(group)
            own = group[np.argsort(-self._gain(group, point))]
            own = own[np.unique(self.frame_of[own], return_index=True)[1]]
            gain = self._gain(own, point)
            own, gain = own[gain > 0.0], gain[gain > 0.0]
            # what is seen less often is no reflector to the back end, and most of it are ghosts
            if len(own) >= self._fewest and gain.sum() > self._cost(own):
                found.append(self._mean(own)[None])
                free[np.searchsorted(left, group)] = False
        points = np.concatenate(found)
        new = np.full(len(points) - len(reflectors.ids), ANONYMOUS)
        return ReflectorPoints(points, np.append(reflectors.ids, new))

    def _needed(self, reflectors: ReflectorPoints) -> ReflectorPoints:
        """Without those, least needed first, that explain less than they cost."""
        while len(reflectors.points) > 1:
            pairs = self._pairs(reflectors)
            net_gain = self._net_gain(pairs, self._match(pairs), len(reflectors.points))
            k = int(np.argmin(net_gain))
            if net_gain[k] >= 0.0:
                break
            reflectors = ReflectorPoints(
                np.delete(reflectors.points, k, 0), np.delete(reflectors.ids, k)
            )
        return reflectors

    def _net_gain(self, pairs: Pairs, at: Indices, m: int) -> Array:
        """What each of m reflectors explains (m,) beyond the others, less its price.

        Without it, its detections go to the nearest one that the look leaves free, or in place of
        what explains less there.
        """
        order = np.argsort(at, kind='stable')
        ends = np.searchsorted(at[order], np.arange(m + 1))
        own_gain = self._gain_of(pairs, at)
        keys = self.frame_of * m + at  # of (look, reflector), sorted below to be searched
        used = np.flatnonzero(at >= 0)
        used = used[np.argsort(keys[used], kind='stable')]
        sorted_keys = keys[used]
        out = np.empty(m)
        for k in range(m):
            own = order[ends[k] : ends[k + 1]]
            if not len(own):
                out[k] = -np.inf
                continue
            reflector = pairs.reflector[own]
            gain = np.where(reflector == k, 0.0, np.maximum(pairs.gain[own], 0.0))
            key = self.frame_of[own, None] * m + reflector
            slot = np.minimum(np.searchsorted(sorted_keys, key), len(sorted_keys) - 1)
            taken = (sorted_keys[slot] == key) & (reflector >= 0)
            gain -= np.where(taken, np.minimum(own_gain[used[slot]], gain), 0.0)
            best = gain.argmax(axis=1)
            other = gain[np.arange(len(own)), best]
            loss = float((own_gain[own] - other).sum())
            to = reflector[np.arange(len(own)), best][other > 0.0]
            out[k] = loss - self._cost(own)
            if len(to):
                j = int(np.bincount(to).argmax())
                out[k] -= _entropy(self.frame_of[own], self.frame_of[order[ends[j] : ends[j + 1]]])
        return out

    @staticmethod
    def _gain_of(pairs: Pairs, at: Indices) -> Array:
        """Of the associations (n,), 0 for none."""
        hit = (pairs.reflector == at[:, None]) & (at[:, None] >= 0)
        return np.asarray(np.where(hit, pairs.gain, 0.0).sum(axis=1))

    def _gain(self, rows: Indices, point: Array) -> Array:
        """Log odds (k,) of some detections for a reflector at point (2,) against nothing."""
        d2 = _distance2(self._points[rows] - point, self._W[rows])
        return np.asarray(self._peak[rows] - 0.5 * d2)

    def _mean(self, rows: Indices) -> Array:
        """Where the detections say that their reflector is (2,)."""
        W = self._W[rows]
        weighted = (W @ self._points[rows][..., None]).sum(axis=0)[:, 0]
        return np.asarray(np.linalg.solve(W.sum(axis=0), weighted))

    def _cost(self, rows: Indices) -> float:
        """Cost of a position with covariance P: - log(density 2 pi sqrt det P)."""
        logdet = float(np.linalg.slogdet(self._W[rows].sum(axis=0))[1])
        return 0.5 * logdet - math.log(2.0 * math.pi * self._density)


def _distance2(nu: Array, W: Array) -> Array:
    """Squared Mahalanobis distances of nu (..., 2) by W (..., 2, 2)."""
    return np.asarray(np.einsum('...i,...ij,...j->...', nu, W, nu))


def _assigned(reflector: Indices, gain: Array) -> Indices:
    """Likeliest of ``reflector`` (k, NEAREST) for each detection of a frame, each once."""
    out = np.full(len(reflector), -1)
    names, column = np.unique(reflector, return_inverse=True)
    full = np.zeros((len(reflector), len(names)))
    rows = np.broadcast_to(np.arange(len(reflector))[:, None], reflector.shape)
    np.maximum.at(full, (rows, column.reshape(reflector.shape)), np.maximum(gain, 0.0))
    r, c = linear_sum_assignment(full, maximize=True)
    good = full[r, c] > 0.0
    out[r[good]] = names[c[good]]
    return out


def _entropy(a: Indices, b: Indices) -> float:
    """Of which of two reflectors is seen in a look, over the looks at a (k,) and b (l,) [nat]."""
    both = len(np.intersect1d(a, b))
    n = np.array([both, len(a) - both, len(b) - both])
    n = n[n > 0]
    return float(-(n * np.log(n / n.sum())).sum())


def _numbered(
    reflectors: ReflectorPoints, associations: Indices
) -> tuple[ReflectorPoints, Indices]:
    """Only the reflectors with detections, renumbered."""
    used = np.unique(associations)
    used = used[used >= 0]
    new = np.full(len(reflectors.points) + 1, -1)
    new[used] = np.arange(len(used))
    return ReflectorPoints(reflectors.points[used], reflectors.ids[used]), new[associations]
