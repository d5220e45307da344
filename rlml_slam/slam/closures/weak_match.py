# SPDX-License-Identifier: Apache-2.0
"""Weak matches: below ``loop_closure.min_score``, found by a wide search of a local map.

The score of a scan at its own place depends on the building: glass, chairs and people cost as much
in one as a wrong place does in another. A weak match is evidence, but never enough alone: it has
negative prior log odds, and enters the graph only with matches from other viewpoints that agree
with it (closure_consistency.py).
"""

from __future__ import annotations

from collections.abc import Sequence

from rlml_slam.slam.closures.closure_matching import Match
from rlml_slam.slam.closures.loop_closure import Closure

OUTSCORED = 'the keyframe has a better weak match'


def keep_best(results: Sequence[Match | Closure]) -> list[Match | Closure]:
    """The results of one keyframe with at most one weak match: it has only one viewpoint."""
    weak = [r for r in results if isinstance(r, Match) and r.weak]
    best = max(weak, key=lambda r: r.score, default=None)
    return [
        r.closure(OUTSCORED) if isinstance(r, Match) and r.weak and r is not best else r
        for r in results
    ]
