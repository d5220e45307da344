# SPDX-License-Identifier: Apache-2.0
"""A scan searched in a finished submap by branch and bound, refined, and verified.

By its score, by the lead over the second-best place, and by whether it is held in all directions.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rlml_slam.matching.scans import branch_and_bound, scan_information
from rlml_slam.matching.scans.scan_match import linearize, match
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe

OPEN = 1e-2  # [1/m², 1/rad²] an edge knows its directions to 10 m and 10 rad at the worst
HELD = 1.0  # [m] a closure holds its place to this in any direction, or may be of another one
PYRAMIDS = 6  # search pyramids kept, more than are searched at a time: each is twice its submap


SECOND, OPEN_WAY = 'a second place fits as well', 'the scan leaves a direction open'
UNDECIDED = (SECOND, OPEN_WAY)  # such a scan contradicts nothing


@dataclass(frozen=True)
class Match:
    """A keyframe that fits a submap at ``T_grid_key`` (3,), with the information (3, 3) there.

    ``searched`` is the area [m²] of its candidate, ``odds`` the logarithm of how much likelier
    right than any match it is, ``source`` what proposed it, ``pairs`` keys of reflectors that are
    one with it, ``sight`` [m] within which half of what the scan sees is; the others as in
    Closure.
    """

    m: KeyframeSubmap
    key: Keyframe
    T_grid_key: Array
    information: Array
    score: float
    overlap: float
    second: float
    searched: float
    odds: float = 0.0
    source: str = ''
    pairs: tuple[tuple[int, int], ...] = ()
    sight: float = 0.0

    def closure(self, why: str, edge: int = -1, number: int = -1) -> Closure:
        """Its record."""
        return Closure(
            self.m.anchor.index, self.key.index, self.T_grid_key, self.score, edge, why,
            self.overlap, self.second, number,
        )  # fmt: skip


class Tried(NamedTuple):
    """What came of a candidate, and the places (n, 3), grid's frame, that the scan fits alike."""

    candidate: Candidate
    result: Match | Closure
    places: Array


class Matcher:
    """Searches and verifies; keeps what the search needs of submaps from one time to the next."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._pyramids: OrderedDict[KeyframeSubmap, branch_and_bound.Pyramid] = OrderedDict()

    def match(self, candidate: Candidate, key: Keyframe, points: Array) -> Tried:
        """Search and verify ``points`` (n, 2) of a keyframe; the record of what failed."""
        p, m, guess = self._p.loop_closure, candidate.m, candidate.guess
        i, j = m.anchor.index, key.index

        def rejected(why: str, score: float = 0.0, *places: Array) -> Tried:
            closure = Closure(i, j, guess, score, -1, why)
            return Tried(candidate, closure, np.array(places).reshape(-1, 3))

        result = branch_and_bound.wide(
            self._pyramid(m), points, guess, candidate.window, candidate.angle, p.min_score,
            second_share=p.ambiguity_ratio,
        )  # fmt: skip
        if result.best is None:
            return rejected('no place in the window fits')
        if (
            result.second is not None
            and result.second.score > p.ambiguity_ratio * result.best.score
        ):
            return rejected(SECOND, result.best.score, result.best.pose, result.second.pose)
        weak = np.diag(1.0 / np.array([0.5, 0.5, 0.2]) ** 2)
        found = match(m.submap, points, result.best.pose, weak, self._p.scan_match, searched=False)
        if found.score < p.min_score:
            return rejected('the refined fit is too weak', found.score)
        information = scan_information.information(
            m.submap, points, found.pose, self._p.scan_match
        )
        if np.linalg.eigvalsh(np.linalg.inv(information + OPEN * np.eye(3))[:2, :2])[1] > HELD**2:
            return rejected(OPEN_WAY, found.score, found.pose)
        term = linearize(m.submap, points, found.pose)
        second = math.nan if result.second is None else result.second.score / result.best.score
        overlap = term.inliers / max(term.count, 1)
        assert key.origin is not None
        sight = float(np.median(np.hypot(*(points - key.origin).T)))
        fit = Match(
            m, key, found.pose, information, found.score, overlap, second, candidate.searched,
            sight=sight,
        )  # fmt: skip
        return Tried(candidate, fit, found.pose[None])

    def _pyramid(self, m: KeyframeSubmap) -> branch_and_bound.Pyramid:
        if m not in self._pyramids:
            self._pyramids[m] = branch_and_bound.Pyramid(m.submap)
            if len(self._pyramids) > PYRAMIDS:
                self._pyramids.popitem(last=False)
        self._pyramids.move_to_end(m)
        return self._pyramids[m]
