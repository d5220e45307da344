# SPDX-License-Identifier: Apache-2.0
"""Looks for a scan that does not fit where odometry led: there may be one place close by.

Odometry that slips, jumps or has a wrong stamp misleads by what the robot does in a second or so,
which is more than the search around its prior covers, and far less than being carried away. What
fits as usual, and nowhere else as far as that, is a scan of this submap and odometry was wrong.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rlml_slam.estimation.health import eigenvalues_2x2
from rlml_slam.matching.scans.branch_and_bound import Criteria, Window, wide
from rlml_slam.matching.scans.scan_match import ScanMatchResult, match
from rlml_slam.matching.scans.search_pyramid import Pyramid
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.scan_relocalization import MAX_SECOND, SPREAD
from rlml_slam.types import Motion

FAR = 3.0  # [sigma] of the prior, that a search covers
UNSEEN = 0.35  # [m] 1 sigma of a motion of which no scan shows the way
REACH = 1.0  # [m] half width of the search: about a second of driving
TURN = 1.0  # [rad] and of turning
LOOKUPS = 50_000_000  # of a search, which takes 50 ms then; 2 million are usual
# Share of the usual score. Of scans in their place, one in fifty of a real log has less; in a
# wrong place of the same room, with some of its walls where others are, three quarters are common.
AS_USUAL = 0.9
NEAR = np.diag(1.0 / SPREAD**2)  # a weak prior at the place found: odometry is no evidence here


def may_have_left(motion: Motion, lasted: float, p: Parameters) -> bool:
    """Whether the robot drove so far in a gap of ``lasted`` [s] that it may be in a new place."""
    is_gap = motion.known and lasted > p.motion.max_gap
    return is_gap and eigenvalues_2x2(motion.cov[:2, :2])[1] > UNSEEN**2


def match_after_gap(
    submap: Submap, points: Array, prior: Array, strength: Array, usual: float, p: Parameters
) -> ScanMatchResult | None:
    """The only place within FAR sigmas of a ``prior`` (3,) with information ``strength`` (3, 3).

    None if there is none, or if the submap shows too little to say that it is the only one.
    """
    cov: Array = np.asarray(np.linalg.inv(strength), dtype=np.float64)
    reach = FAR * math.sqrt(eigenvalues_2x2(cov[:2, :2])[1])
    if reach > p.submap.max_laser_range:
        return None
    turn = min(FAR * math.sqrt(cov[2, 2]), math.pi)
    return recover_locally(submap, points, prior, usual, p, turn, max(reach, REACH))


def recover_locally(
    submap: Submap,
    points: Array,
    guess: Array,
    usual: float,
    p: Parameters,
    turn: float = TURN,
    reach: float = REACH,
) -> ScanMatchResult | None:
    """The only place near ``guess`` (3,), submap frame, where a scan fits as it should.

    ``points`` (n, 2) are thinned end points in the base frame, ``usual`` is the score of scans
    lately, ``turn`` [rad] and ``reach`` [m] how far off they may be. None where nothing fits, or a
    second place about as well. The result leaves nothing of the prior: its weight is zero.
    """
    least = max(AS_USUAL * usual, p.loop_closure.min_score)
    window = Window(guess, (reach, reach), turn)
    criteria = Criteria(MAX_SECOND * least, second_share=MAX_SECOND, budget=LOOKUPS)
    found = wide(Pyramid(submap), points, window, criteria)
    if found.best is None or found.second is not None or not found.complete:
        return None
    result = match(submap, points, found.best.pose, NEAR, p.scan_match, searched=False)
    return replace(result, prior_weight=0.0) if result.score >= least else None
