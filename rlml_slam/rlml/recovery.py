# SPDX-License-Identifier: Apache-2.0
"""Finds a lost robot in the whole map: at start in a saved map, and after it was carried away.

What is ambiguous or impossible changes nothing: the robot stays lost, and the next frames are
tried as it moves on. Nothing of what is seen meanwhile is put into the map.

A search costs more than all else. The longer the robot is lost, the rarer they are: it is found a
tenth later than it could be at worst, and a night in a room that is not mapped costs a hundred.
"""

from __future__ import annotations

from collections.abc import Callable

from rlml_slam.maps.saved import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.rlml.find_place import find_place
from rlml_slam.rlml.relocalize import Relocation
from rlml_slam.types import Frame, Level, Verdict

PERIOD = 300_000_000  # [ns] of stamps between two searches, at first
RARER = 10  # part of the time for which the robot is lost that is between two, later


class Recovery:
    """Looks at every frame, and searches the map where a frame is lost; ``why`` is its verdict."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._map: SavedMap | None = None  # as it was when the robot was lost: nothing is added
        self._since: int | None = None
        self._next = 0
        self.why = ''

    def look(
        self, frame: Frame, current: Callable[[], SavedMap], complete: bool
    ) -> Relocation | None:
        """The only place of a lost frame in the map, which is ``complete`` or in the making."""
        lost = frame.health.level is Level.LOST
        if not (lost or frame.doubtful):
            self._since, self._map, self.why = None, None, ''
            return None
        if self._since is None or frame.stamp < self._since:
            self._since = self._next = frame.stamp
        waited = frame.stamp - self._since >= self._p.health.lost_time * 1e9
        if not (lost or waited) or frame.stamp < self._next:
            return None
        self._next = frame.stamp + max(PERIOD, (frame.stamp - self._since) // RARER)
        if self._map is None:
            self._map = current()
        grid, reflectors = self._map.grid, self._map.reflectors
        found = find_place(grid, reflectors, frame.observation, self._p, complete)
        self.why = found.why
        return found if found.verdict is Verdict.UNIQUE else None
