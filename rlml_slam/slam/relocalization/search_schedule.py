# SPDX-License-Identifier: Apache-2.0
"""How often a robot whose place is unknown is looked for in the whole map.

A search costs more than all else, and from the same pose its result is the same. So the
longer it stays there, the rarer they are: it is found a tenth later than it could be at worst, or
half a minute. Once it has moved on, it is looked for at once. How far that is grows as well, by a
tenth of all it has moved: a robot that drives through what is not mapped is searched ever less.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.types import Frame

PERIOD = 300_000_000  # [ns] of stamps between two searches at least
DRAWN = 1_000_000_000  # [ns] of the same, and before the first, in a map to be drawn first
RARER = 10  # part of the time since the first that is between two where the robot stands
LONGEST = 30_000_000_000  # [ns] of stamps between two searches at most
MOVED, TURNED = 1.0, 0.5  # [m], [rad] since the last search: from there, it may see more
FARTHEST, FULL_TURN = 5.0, 2.0  # [m], [rad] of these at most


class SearchSchedule:
    """Times of the searches from a stamp on, which is that of the first frame without a place.

    A map in the making has to be ``drawn``: for a scan or two that do not fit, it is not.
    """

    def __init__(self, since: int, drawn: bool = False) -> None:
        self.since = since
        self._first, self._period = (since + DRAWN, DRAWN) if drawn else (since, PERIOD)
        self._last: int | None = None
        self._there = np.zeros(3)
        self._moves = 0  # searches because it had moved

    def is_due(self, frame: Frame) -> bool:
        """Whether to search now; the next search counts from this one."""
        if frame.stamp < self._first:
            return False
        if self._last is not None and frame.stamp >= self._last:
            x, y, turn = se2.between(self._there, frame.T_map_base)
            more = 1.0 + self._moves / RARER
            moved = math.hypot(x, y) > min(more * MOVED, FARTHEST) or abs(turn) > min(
                more * TURNED, FULL_TURN
            )
            pause = max(self._period, min((self._last - self.since) // RARER, LONGEST))
            if frame.stamp - self._last < (self._period if moved else pause):
                return False
            self._moves += moved
        self._last, self._there = frame.stamp, frame.T_map_base
        return True
