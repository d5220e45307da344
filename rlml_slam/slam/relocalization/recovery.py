# SPDX-License-Identifier: Apache-2.0
"""Finds a lost robot in the whole map: at start in a saved map, and after it was carried away.

What is ambiguous or impossible changes nothing: the robot stays lost, and the next frames are
tried as it moves on. Nothing of what is seen meanwhile is put into the map.
"""

from __future__ import annotations

from collections.abc import Callable

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.slam.relocalization.search_schedule import SearchSchedule
from rlml_slam.types import Frame, Level, Verdict


class Recovery:
    """Looks at every frame, and searches the map where a frame is lost; ``why`` is its verdict."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._map: SavedMap | None = None  # as it was when the robot was lost: nothing is added
        self._pace: SearchSchedule | None = None
        self.why = ''

    def look(
        self, frame: Frame, current: Callable[[], SavedMap], complete: bool
    ) -> Relocation | None:
        """The only place of a lost frame in the map, which is ``complete`` or in the making."""
        lost = frame.health.level is Level.LOST
        if not (lost or frame.unconfirmed):
            self._pace, self._map, self.why = None, None, ''
            return None
        if self._pace is None or frame.stamp < self._pace.since:
            self._pace = SearchSchedule(frame.stamp)
        waited = frame.stamp - self._pace.since >= self._p.health.lost_time * 1e9
        if not (lost or waited) or not self._pace.is_due(frame):
            return None
        if self._map is None:
            self._map = current()
        grid, reflectors = self._map.grid, self._map.reflectors
        found = localize_globally(grid, reflectors, frame.observation, self._p, complete)
        self.why = found.why
        return found if found.verdict is Verdict.UNIQUE else None
