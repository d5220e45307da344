# SPDX-License-Identifier: Apache-2.0
"""Scan match of a keyframe with a finished submap: branch and bound, refinement, verification.

Verified by the score, for which end points behind walls fit nothing, by the ratio of the
second-best score to the best one, and by the covariance: a scan has to constrain its pose in all
directions, by walls that the submap saw from the same side. Where the drift is large, weak matches
are searched for as well (weak_match.py).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rlml_slam.matching.scans import scan_information
from rlml_slam.matching.scans.branch_and_bound import Criteria, WideResult, Window, wide
from rlml_slam.matching.scans.scan_match import linearize, match
from rlml_slam.matching.scans.search_pyramid import Pyramid
from rlml_slam.matching.scans.submap import P_MIN, Submap
from rlml_slam.matching.scans.visibility import hidden_share
from rlml_slam.matching.scans.wall_sides import least_share, of_seen_sides
from rlml_slam.params import LoopClosure, Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.closure_consistency import REPEATED_WRONG
from rlml_slam.slam.closures.keyframe_submap import WEAK_INFORMATION, KeyframeSubmap, edge_of_match
from rlml_slam.slam.closures.local_map import Surroundings, local_map
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe

MAX_SIGMA = 1.0  # [m] largest standard deviation of the position of a match, in any direction
PYRAMIDS = (
    6  # search pyramids kept, more than are searched at a time: each is three times its submap
)
WEAK_SHARE = 0.85  # of the smallest score: below, wrong places of a local map score as well
MAX_LOOKUPS = 5_000_000  # of a search, after which weak matches are not looked for any more
LEAST_SEEN = 0.2  # share of the information that has to be of seen sides, in each direction
SEARCH_SIGMA = np.array([0.5, 0.5, 0.2])  # [m, m, rad] prior of the refinement at the best cell

AMBIGUOUS, DEGENERATE = 'a second pose fits as well', 'the scan does not constrain one direction'
HIDDEN = 'walls of the submap hide what the scan sees'
OTHER_SIDE = 'walls that hold it in one direction were seen from the other side'
UNDECIDED = (AMBIGUOUS, DEGENERATE, HIDDEN, OTHER_SIDE)  # such a match contradicts nothing


@dataclass(frozen=True)
class Match:
    """Verified match of a keyframe with a submap at ``T_grid_key`` (3,), information (3, 3).

    ``search_area`` [m²] of its candidate; ``log_odds`` of being correct from what proposed it,
    the ``source``; ``reflector_pairs`` are keys of reflectors that the closure joins;
    ``view_range`` [m] is the median range of the scan; a ``weak`` match has a score below the
    usual least one, a ``wide`` one is of a search for a robot whose place is uncertain. The others
    as in Closure.
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
    weak: bool = False
    wide: bool = False

    def closure(self, why: str, edge: int = -1, number: int = -1) -> Closure:
        """Record of the match, accepted with an ``edge``."""
        return Closure(
            self.m.anchor.index, self.key.index, self.T_grid_key, self.score, edge, why,
            self.overlap, self.second, number,
        )  # fmt: skip

    def edge(self, p: LoopClosure) -> tuple[int, int, Array, Array]:
        """Keyframes i, j, the pose of j in i (3,), and its information (3, 3)."""
        floor = np.array(p.variance_floor)
        measured = edge_of_match(self.m.T_anchor_grid, self.T_grid_key, self.information, floor)
        return self.m.anchor.index, self.key.index, *measured


class SearchResult(NamedTuple):
    """Result for a candidate, and the poses (n, 3) of the grid frame that fit equally well."""

    candidate: Candidate
    result: Match | Closure
    poses: Array


class _Searched(NamedTuple):
    """Grid that is searched, and its pyramid."""

    submap: Submap
    pyramid: Pyramid


class ClosureMatcher:
    """Searches and verifies matches; caches the search pyramids of the latest submaps."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._searched: OrderedDict[tuple[KeyframeSubmap, bool], _Searched] = OrderedDict()

    def match(
        self,
        candidate: Candidate,
        key: Keyframe,
        points: Array,
        surroundings: Surroundings | None = None,
    ) -> SearchResult:
        """Match ``points`` (n, 2) of a keyframe; a Closure as record of a rejected match.

        With ``surroundings``, a window that is wider than the smallest one is searched in the
        local map, and for weak matches as well.
        """
        p, m, guess = self._p.loop_closure, candidate.m, candidate.guess
        i, j = m.anchor.index, key.index

        def rejected(why: str, score: float = 0.0, *poses: Array) -> SearchResult:
            closure = Closure(i, j, guess, score, -1, why)
            return SearchResult(candidate, closure, np.array(poses).reshape(-1, 3))

        if candidate.window <= p.search_window:
            surroundings = None
        submap, pyramid = self._grid(m, surroundings)
        result = self._search(pyramid, candidate, points, surroundings is not None)
        if result.best is None:
            return rejected('no pose in the search window fits')
        if (
            result.second is not None
            and result.second.score > p.ambiguity_ratio * result.best.score
        ):
            return rejected(AMBIGUOUS, result.best.score, result.best.pose, result.second.pose)
        prior = np.diag(1.0 / SEARCH_SIGMA**2)
        found = match(submap, points, result.best.pose, prior, self._p.scan_match, searched=False)
        least = p.min_score * (1.0 if surroundings is None else WEAK_SHARE)
        if found.score < least:
            return rejected('the score after refinement is too low', found.score)
        assert key.origin is not None
        hidden = hidden_share(submap, points, key.origin, found.pose)
        seen = found.score - hidden * (found.score - P_MIN)  # eq. 63
        if seen < least:
            return rejected(HIDDEN, seen)
        information = scan_information.information(submap, points, found.pose, self._p.scan_match)
        if _largest_variance(information) > MAX_SIGMA**2:
            return rejected(DEGENERATE, seen, found.pose)
        facing = points[of_seen_sides(submap, points, key.origin, found.pose)]
        faced = scan_information.information(submap, facing, found.pose, self._p.scan_match)
        if least_share(faced, information) < LEAST_SEEN:  # eq. 66
            return rejected(OTHER_SIDE, seen, found.pose)
        term = linearize(submap, points, found.pose)
        second = math.nan if result.second is None else result.second.score / result.best.score
        overlap = term.inliers / max(term.count, 1)
        view_range = float(np.median(np.hypot(*(points - key.origin).T)))
        log_odds = self._log_odds(min(result.best.score, seen))
        wide = candidate.search_area > p.searched
        fit = Match(
            m, key, found.pose, information, seen, overlap, second, candidate.search_area,
            log_odds, view_range=view_range, weak=log_odds < 0.0, wide=wide,
        )  # fmt: skip
        return SearchResult(candidate, fit, found.pose[None])

    def _search(
        self, pyramid: Pyramid, candidate: Candidate, points: Array, weak_too: bool
    ) -> WideResult:
        """Best pose in the search window; of a wide one, where the submap knows something."""
        p = self._p.loop_closure
        half_width, is_wide = (candidate.window,) * 2, candidate.window > p.search_window
        window = Window(candidate.guess, half_width, candidate.angle, mapped=is_wide)
        # weak ones need other viewpoints anyway, so no second pose of theirs is looked for
        criteria = Criteria(
            p.min_score, second_share=p.ambiguity_ratio,
            weak_score=WEAK_SHARE * p.min_score if weak_too else None, weak_budget=MAX_LOOKUPS,
        )  # fmt: skip
        return wide(pyramid, points, window, criteria)

    def _log_odds(self, score: float) -> float:
        """Prior log odds of a match by its score, eq. 58: 0, or negative for a weak one."""
        least = self._p.loop_closure.min_score
        return max(least - score, 0.0) / ((1.0 - WEAK_SHARE) * least) * math.log(REPEATED_WRONG)

    def _grid(self, m: KeyframeSubmap, surroundings: Surroundings | None) -> _Searched:
        """The submap, or its local map, with its search pyramid."""
        name = m, surroundings is not None
        if name not in self._searched:
            submap = m.submap if surroundings is None else local_map(m, surroundings)
            self._searched[name] = _Searched(submap, Pyramid(submap))
            if len(self._searched) > PYRAMIDS:
                self._searched.popitem(last=False)
        self._searched.move_to_end(name)
        return self._searched[name]


def _largest_variance(information: Array) -> float:
    """Largest variance [m²] of the position, of an information (3, 3) of the pose."""
    cov = np.linalg.inv(information + WEAK_INFORMATION * np.eye(3))
    return float(np.linalg.eigvalsh(cov[:2, :2])[1])
