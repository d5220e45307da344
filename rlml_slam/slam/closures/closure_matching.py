# SPDX-License-Identifier: Apache-2.0
"""Scan match of a keyframe with a finished submap: branch and bound, refinement, verification.

Verified by the score, by the ratio of the second-best score to the best one, and by the
covariance: a scan has to constrain its pose in all directions.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rlml_slam.matching.scans import scan_information
from rlml_slam.matching.scans.branch_and_bound import Criteria, Window, wide
from rlml_slam.matching.scans.scan_match import linearize, match
from rlml_slam.matching.scans.search_pyramid import Pyramid
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.keyframe_submap import WEAK_INFORMATION, KeyframeSubmap
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe

MAX_SIGMA = 1.0  # [m] largest standard deviation of the position of a match, in any direction
PYRAMIDS = (
    6  # search pyramids kept, more than are searched at a time: each is three times its submap
)
SEARCH_SIGMA = np.array([0.5, 0.5, 0.2])  # [m, m, rad] prior of the refinement at the best cell

AMBIGUOUS, DEGENERATE = 'a second pose fits as well', 'the scan does not constrain one direction'
UNDECIDED = (AMBIGUOUS, DEGENERATE)  # such a match contradicts nothing


@dataclass(frozen=True)
class Match:
    """Verified match of a keyframe with a submap at ``T_grid_key`` (3,), information (3, 3).

    ``search_area`` [m²] of its candidate; ``log_odds`` of being correct from what proposed it,
    the ``source``; ``reflector_pairs`` are keys of reflectors that the closure joins;
    ``view_range`` [m] is the median range of the scan; the others as in Closure.
    """

    m: KeyframeSubmap
    key: Keyframe
    T_grid_key: Array
    information: Array
    score: float
    overlap: float
    second: float
    search_area: float
    log_odds: float = 0.0
    source: str = ''
    reflector_pairs: tuple[tuple[int, int], ...] = ()
    view_range: float = 0.0

    def closure(self, why: str, edge: int = -1, number: int = -1) -> Closure:
        """Record of the match, accepted with an ``edge``."""
        return Closure(
            self.m.anchor.index, self.key.index, self.T_grid_key, self.score, edge, why,
            self.overlap, self.second, number,
        )  # fmt: skip


class SearchResult(NamedTuple):
    """Result for a candidate, and the poses (n, 3) of the grid frame that fit equally well."""

    candidate: Candidate
    result: Match | Closure
    poses: Array


class ClosureMatcher:
    """Searches and verifies matches; caches the search pyramids of the latest submaps."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._pyramids: OrderedDict[KeyframeSubmap, Pyramid] = OrderedDict()

    def match(self, candidate: Candidate, key: Keyframe, points: Array) -> SearchResult:
        """Match ``points`` (n, 2) of a keyframe; a Closure as record of a rejected match."""
        p, m, guess = self._p.loop_closure, candidate.m, candidate.guess
        i, j = m.anchor.index, key.index

        def rejected(why: str, score: float = 0.0, *poses: Array) -> SearchResult:
            closure = Closure(i, j, guess, score, -1, why)
            return SearchResult(candidate, closure, np.array(poses).reshape(-1, 3))

        result = wide(
            self._pyramid(m),
            points,
            Window(guess, (candidate.window, candidate.window), candidate.angle),
            Criteria(p.min_score, second_share=p.ambiguity_ratio),
        )
        if result.best is None:
            return rejected('no pose in the search window fits')
        if (
            result.second is not None
            and result.second.score > p.ambiguity_ratio * result.best.score
        ):
            return rejected(AMBIGUOUS, result.best.score, result.best.pose, result.second.pose)
        prior = np.diag(1.0 / SEARCH_SIGMA**2)
        found = match(
            m.submap, points, result.best.pose, prior, self._p.scan_match, searched=False
        )
        if found.score < p.min_score:
            return rejected('the score after refinement is too low', found.score)
        information = scan_information.information(
            m.submap, points, found.pose, self._p.scan_match
        )
        if _largest_variance(information) > MAX_SIGMA**2:
            return rejected(DEGENERATE, found.score, found.pose)
        term = linearize(m.submap, points, found.pose)
        second = math.nan if result.second is None else result.second.score / result.best.score
        overlap = term.inliers / max(term.count, 1)
        assert key.origin is not None
        view_range = float(np.median(np.hypot(*(points - key.origin).T)))
        fit = Match(
            m, key, found.pose, information, found.score, overlap, second, candidate.search_area,
            view_range=view_range,
        )  # fmt: skip
        return SearchResult(candidate, fit, found.pose[None])

    def _pyramid(self, m: KeyframeSubmap) -> Pyramid:
        if m not in self._pyramids:
            self._pyramids[m] = Pyramid(m.submap)
            if len(self._pyramids) > PYRAMIDS:
                self._pyramids.popitem(last=False)
        self._pyramids.move_to_end(m)
        return self._pyramids[m]


def _largest_variance(information: Array) -> float:
    """Largest variance [m²] of the position, of an information (3, 3) of the pose."""
    cov = np.linalg.inv(information + WEAK_INFORMATION * np.eye(3))
    return float(np.linalg.eigvalsh(cov[:2, :2])[1])
