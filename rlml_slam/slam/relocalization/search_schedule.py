# SPDX-License-Identifier: Apache-2.0
"""How often a robot whose place is unknown is looked for in the whole map.

A search costs more than all else, and from the same pose its result is the same. So the
longer it stays there, the rarer they are: it is found a tenth later than it could be at worst, or
half a minute. Once it has moved on, it is looked for at once.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.types import Frame

PERIOD = 300_000_000  # [ns] of stamps between two searches at least
RARER = 10  # part of the time since the first that is between two where the robot stands
LONGEST = 30_000_000_000  # [ns] of stamps between two searches at most
MOVED, TURNED = 1.0, 0.5  # [m], [rad] since the last search: from there, it may see more


class SearchSchedule:
    """Times of the searches from a stamp on, which is that of the first frame without a place."""

    def __init__(self, since: int) -> None:
        self.since = since
        self._last: int | None = None
        self._there = np.zeros(3)

    def is_due(self, frame: Frame) -> bool:
        """Whether to search now; the next search counts from this one."""
        if self._last is not None and frame.stamp >= self._last:
            x, y, turn = se2.between(self._there, frame.T_map_base)
            moved = math.hypot(x, y) > MOVED or abs(turn) > TURNED
            pause = max(PERIOD, min((self._last - self.since) // RARER, LONGEST))
            if frame.stamp - self._last < (PERIOD if moved else pause):
                return False
        self._last, self._there = frame.stamp, frame.T_map_base
        return True
