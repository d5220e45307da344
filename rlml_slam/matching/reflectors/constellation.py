# SPDX-License-Identifier: Apache-2.0
"""Global pose in a map of reflectors from anonymous detections, with a test of uniqueness.

Every pose at which at least three detections fall on reflectors is found (pair_votes), fitted and
scored. The best one is unique only where chance does not make such a match and no other pose is
nearly as good. All of it stays the same when the map is moved or anything is put in another order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.special import bdtr, bdtrc, betaincinv

from rlml_slam import se2
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.pair_votes import (
    MAX_TESTS,
    MIN_MATCHES,
    Measured,
    PosePrior,
    buckets_of,
    pairs_of,
    vote,
)
from rlml_slam.matching.reflectors.pose_fit import LOOSE, refine
from rlml_slam.params import Relocalization
from rlml_slam.se2 import Array
from rlml_slam.types import Verdict

MAX_CANDIDATES = 50  # different poses that are fitted; those with fewest matches are left out
TYPICAL = 5  # rank behind the best of the candidate that measures the matches by chance
SAME_PLACE, SAME_TURN = 0.1, 0.02  # [m], [rad] poses as near as this are one


@dataclass(frozen=True)
class Prior:
    """What is known of the pose before: ``pose`` (3,) with ``cov`` (3, 3), map frame."""

    pose: Array
    cov: Array


@dataclass(frozen=True)
class Candidate:
    """A pose that the detections allow, map frame.

    ``pose`` (3,) of base with ``cov`` (3, 3); ``match`` (k,) is each detection's reflector, -1
    for none. ``score`` is the log of the likelihood against one of all detections being ghosts;
    ``chi2`` the squared Mahalanobis distance of the ``num_matches`` matches. Of the reflectors
    within ``max_range``, ``num_near`` match a detection and ``num_unseen`` do not. ``chance`` is
    how many poses are expected to match as many among reflectors that stand at random.
    """

    pose: Array
    cov: Array
    match: NDArray[np.int64]
    score: float
    chi2: float
    num_near: int
    num_unseen: int
    chance: float = float('inf')

    @property
    def num_matches(self) -> int:
        """Detections that fall on a reflector."""
        return int((self.match >= 0).sum())

    @property
    def support(self) -> int:
        """Reflectors that speak for the pose, less those that speak against it.

        One that was moved or a single ghost in its place must never decide alone.
        """
        return self.num_matches - self.num_unseen


@dataclass(frozen=True)
class Constellation:
    """The verdict, why in words, and the candidates, best first.

    One candidate where unique, none where impossible or not searched. ``chance`` is how many poses
    are expected to match as many detections as the best one does by chance, infinite without one.
    ``rivals`` are all other poses found, whatever the verdict.
    """

    verdict: Verdict
    why: str
    candidates: tuple[Candidate, ...] = ()
    chance: float = float('inf')
    rivals: tuple[Candidate, ...] = ()


def locate(
    points: Array,
    cov: Array,
    reflectors: Array,
    reflectors_cov: Array,
    params: Relocalization,
    prior: Prior | None = None,
    max_tests: int = MAX_TESTS,
) -> Constellation:
    """Find detections ``points`` (k, 2) with ``cov`` (k, 2, 2), base frame, among ``reflectors``.

    The reflectors (m, 2) and their covariances (m, 2, 2) are of the map frame. What is not finite
    does not take part. Where the matches lie farther apart than their covariances allow, these
    are widened until they do, once. Where thousands of reflectors stand alike, there may be more
    to be searched than ``max_tests``: then the verdict is just that.
    """
    used = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    k, m = len(used), len(reflectors)
    if m < MIN_MATCHES:
        return Constellation(Verdict.IMPOSSIBLE, f'the map has {m} reflectors, three are needed')
    if k < MIN_MATCHES:
        return Constellation(Verdict.IMPOSSIBLE, f'{k} reflectors are seen, three are needed')
    z = np.ascontiguousarray(points[used], dtype=np.float64)
    z_cov = cov[used] + params.sigma_floor**2 * np.eye(2)
    p = np.ascontiguousarray(reflectors, dtype=np.float64)
    p_cov = np.ascontiguousarray(reflectors_cov, dtype=np.float64)
    result = _Search(z, z_cov, p, p_cov, params, max_tests).run(prior)
    if result.verdict is Verdict.UNIQUE:
        best = result.candidates[0]
        dof = 2 * best.num_matches - (3 if prior is None else 0)
        # the noise is larger than stated, and gates by what was stated may have cut off a rival
        if best.chi2 > gate(1.0 - params.false_positive_probability, dof):
            scale = best.chi2 / dof
            result = _Search(z, scale * z_cov, p, scale * p_cov, params, max_tests).run(prior)
    if k == len(points):
        return result

    def of_all(c: Candidate) -> Candidate:
        match = np.full(len(points), -1, dtype=np.int64)
        match[used] = c.match
        return replace(c, match=match)

    return replace(
        result,
        candidates=tuple(map(of_all, result.candidates)),
        rivals=tuple(map(of_all, result.rivals)),
    )


class _Search:
    """One search: detections z (k, 2) and reflectors p (m, 2) with covariances."""

    def __init__(
        self, z: Array, z_cov: Array, p: Array, p_cov: Array, params: Relocalization,
        max_tests: int,
    ) -> None:  # fmt: skip
        self._max_tests = max_tests
        self._z, self._z_cov, self._p, self._p_cov, self._params = z, z_cov, p, p_cov, params
        self._gate2 = gate(params.gate)
        self._z_var = _largest(z_cov)
        self._p_var = _largest(p_cov)
        self._noise = float(self._z_var.max() + self._p_var.max())
        self._floor2 = self._gate2 * self._noise
        # expected ghosts per m^2
        self._ghosts = max(1.0, params.false_share * len(z)) / _area(z, self._floor2)
        covered = len(p) * np.pi * self._gate2 * (self._p_var.mean() + self._z_var.mean())
        self._covered = min(float(covered / _area(p, self._floor2)), 1.0)  # share, by gates

    def run(self, prior: Prior | None) -> Constellation:
        """Verdict and candidates."""
        found, proposals, searched = self._candidates(prior)
        if not searched:
            return _not_searched(len(self._z), len(self._p))
        if found:
            chance = {n: self._chance([n], proposals) for n in {c.num_matches for c in found}}
            found = [replace(c, chance=chance[c.num_matches]) for c in found]
            result = self._judged(found, proposals)
            return replace(result, rivals=tuple(found[len(result.candidates) :]))
        why = f'no pose matches three of the {len(self._z)} detections with the map'
        return Constellation(Verdict.IMPOSSIBLE, why)

    def _candidates(self, prior: Prior | None) -> tuple[list[Candidate], int, bool]:
        """All different poses, best first; of how many proposals; whether that were all."""
        pose = np.zeros(3) if prior is None else np.array(prior.pose, dtype=np.float64)
        information = np.zeros((3, 3))
        if prior is not None:
            information[:] = np.linalg.inv(prior.cov)
        buckets = buckets_of(self._p, float(np.sqrt((1.0 + LOOSE) * self._floor2)))
        pairs = pairs_of(self._p, float(pdist(self._z).max() + np.sqrt(2.0 * self._floor2)))
        if pairs is None:
            return [], 0, False
        seen = Measured(self._z, self._z_cov, self._z_var)
        known = Measured(self._p, self._p_cov, self._p_var)
        before = PosePrior(pose, information, gate(self._params.gate, 3))
        votes = vote(seen, known, pairs, buckets, self._gate2, before, self._max_tests)
        found: list[Candidate] = []
        matches = np.full((len(self._z), MAX_CANDIDATES), -1, dtype=np.int64)
        bases = votes.bases[np.argsort(-votes.counts, kind='stable')]
        for base, (a, b, i, j) in zip(bases, bases.tolist(), strict=True):
            # a pose that has both matches of the proposal already is what it would lead to
            if ((matches[a] == i) & (matches[b] == j)).any():
                continue
            T, cov, match, chi2 = refine(
                base, seen, known, buckets, self._gate2, self._noise, before
            )
            if (match >= 0).sum() < MIN_MATCHES:
                continue
            candidate = self._scored(T, cov, match, chi2)
            twin = _twin(candidate, found)
            if twin is None:
                matches[:, len(found)] = match
                found.append(candidate)
            elif _rank(candidate) < _rank(found[twin]):
                matches[:, twin], found[twin] = match, candidate
            if len(found) == MAX_CANDIDATES:
                break
        return sorted(found, key=_rank), votes.proposals, votes.searched

    def _scored(self, T: Array, cov: Array, match: NDArray[np.int64], chi2: float) -> Candidate:
        """The likelihood ratio of a pose against one at which every detection is a ghost.

        Inside its gate, the likelihood of a match is constant: in a hall with a repeated layout,
        the residuals of the two poses differ only by the errors of the map, which must not decide
        between them.
        """
        p = self._params
        hit = np.flatnonzero(match >= 0)
        S = self._p_cov[match[hit]] + _turned(self._z_cov[hit], T[2])
        area = np.pi * self._gate2 * np.sqrt(np.linalg.det(S))
        score = float(np.log((1.0 - p.missed_share) / (self._ghosts * area)).sum())
        near = np.hypot(*(self._p - T[:2]).T) < p.max_range
        num_near = int(near[match[hit]].sum())
        num_unseen = int(near.sum()) - num_near
        score += num_unseen * float(np.log(p.missed_share))
        return Candidate(T, cov, match, score, chi2, num_near, num_unseen)

    def _judged(self, found: list[Candidate], proposals: int) -> Constellation:
        """The verdict on candidates, best first."""
        p, k, best = self._params, len(self._z), found[0]
        n = best.num_matches
        chance = self._chance([c.num_matches for c in found], proposals)
        seen = f'{n} of {k} detections match'
        # more ghosts or more missing than there are where the robot stands in this map
        strange = bdtr(n, k, 1.0 - p.false_share) < p.false_positive_probability
        missed = (
            bdtr(best.num_near, best.num_near + best.num_unseen, 1.0 - p.missed_share)
            < p.false_positive_probability
        )
        if chance > p.false_positive_probability:
            if strange:
                why = f'no pose explains the detections: only {seen}'
                return Constellation(Verdict.IMPOSSIBLE, why, chance=chance)
            why = (
                f'{seen}, as many as chance gives: {chance:.2g} wrong poses are expected, more '
                f'than {p.false_positive_probability:.2g}'
            )
            return Constellation(Verdict.AMBIGUOUS, why, tuple(found), chance)
        odds = np.exp([c.score - best.score for c in found])  # against the best one
        close = [c.support >= best.support - 1 for c in found]
        if odds[1:].sum() > p.false_positive_probability or any(close[1:]):
            rivals = [
                c for c, o, near in zip(found, odds, close, strict=True)
                if near or o > p.false_positive_probability / MAX_CANDIDATES
            ]  # fmt: skip
            why = f'{len(rivals)} poses fit alike: {seen}, {found[1].num_matches} at the next'
            return Constellation(Verdict.AMBIGUOUS, why, tuple(rivals), chance)
        if strange or missed:
            unseen = f', {best.num_unseen} reflectors near by are not seen' if missed else ''
            why = f'only {seen} at the best pose{unseen}: the map may be of another place'
            return Constellation(Verdict.AMBIGUOUS, why, (best,), chance)
        sigma = float(np.sqrt(np.linalg.eigvalsh(best.cov[:2, :2])[-1]))
        if sigma > p.max_sigma:
            why = f'{seen} at one pose, which they hold only to {sigma:.2f} m'
            return Constellation(Verdict.AMBIGUOUS, why, (best,), chance)
        return Constellation(Verdict.UNIQUE, f'{seen} at one pose', (best,), chance)

    def _chance(self, num_matches: list[int], proposals: int) -> float:
        """Expected number of poses with as many matches as the first if all were ghosts.

        A contrario (Moisan, Stival 2004): of each proposal, two matches are given and the other
        detections fall into some reflector's gate independently, with the share of the map that
        gates cover. Regular rows of reflectors match more often than that, so the share is raised
        until TYPICAL poses are expected to reach the number of matches of the candidate TYPICAL
        ranks behind the best. The candidates before it are left out, as a nearly symmetric layout
        has some of its own.
        """
        others = len(self._z) - 2
        share = self._covered
        if len(num_matches) > TYPICAL:
            s = sorted(num_matches)[-1 - TYPICAL] - 2
            # at which so many proposals are expected to reach what that many do
            share = max(share, float(betaincinv(s, others - s + 1, min(TYPICAL / proposals, 1.0))))
        return float(proposals * bdtrc(num_matches[0] - 3, others, share))


def _not_searched(k: int, m: int) -> Constellation:
    why = f'{k} detections are too many to be searched among {m} reflectors that stand so alike'
    return Constellation(Verdict.NOT_SEARCHED, why)


def _area(points: Array, floor2: float) -> float:
    """Area [m^2] that points (n, 2) are spread over, moved and turned alike; never of zero width.

    6 sqrt(det cov) is the area of a square with the points on its sides, and half of it with the
    points all over it: the less is safe, for it makes chance likelier.
    """
    d = (points - points.mean(axis=0)).T
    l_0, l_1 = np.linalg.eigvalsh(d.dot(d.T) * (1.0 / len(points)))  # faster than np.cov
    return float(6.0 * np.sqrt((l_0 + floor2) * (l_1 + floor2)))


def _largest(cov: Array) -> Array:
    """Variance (n,) of the worst direction of each covariance (n, 2, 2)."""
    return np.array(np.linalg.eigvalsh(cov)[:, -1], dtype=np.float64)


def _turned(cov: Array, theta: float) -> Array:
    R = se2.rotation(theta)
    turned: Array = R @ cov @ R.T
    return turned


def _rank(c: Candidate) -> tuple[float, float]:
    """Lower is better: the score, and among equals the distance."""
    return (-c.score, c.chi2)


def _twin(c: Candidate, found: list[Candidate]) -> int | None:
    """The first candidate that is the same pose, by distance or by what both covariances allow."""
    if not found:
        return None
    d = np.array([f.pose for f in found]) - c.pose
    d[:, 2] = se2.wrap(d[:, 2])
    S = np.array([f.cov for f in found]) + c.cov
    distance2 = np.einsum('ni,ni->n', d, np.linalg.solve(S, d[..., None])[..., 0])
    close = (np.hypot(d[:, 0], d[:, 1]) < SAME_PLACE) & (np.abs(d[:, 2]) < SAME_TURN)
    same = np.flatnonzero(close | (distance2 < 16.3))  # 99.9 % of three degrees
    return int(same[0]) if len(same) else None
