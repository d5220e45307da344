# SPDX-License-Identifier: Apache-2.0
"""When a lost robot is searched in the map: at the start in a saved map, or after it was moved.

An ambiguous or impossible search changes nothing: the robot stays lost, and later frames are
tried as it moves on. Nothing that is seen meanwhile becomes part of the map.
"""

from __future__ import annotations

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization.search_schedule import SearchSchedule
from rlml_slam.types import Frame, Level


class Recovery:
    """Looks at every frame; ``why`` is the text of the newest search, empty where none was made.

    ``map`` is the map in the making as it was when the robot was lost, None before it was drawn.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._schedule: SearchSchedule | None = None
        self.map: SavedMap | None = None
        self.why = ''

    @property
    def is_active(self) -> bool:
        """Whether the newest frame is lost."""
        return self._schedule is not None

    def stop(self) -> None:
        """The robot knows its place, or has another map."""
        self._schedule, self.map, self.why = None, None, ''

    def follow(self, frame: Frame, drawn: bool = False) -> None:
        """Take the next frame; ``drawn`` as in SearchSchedule."""
        if not (frame.health.level is Level.LOST or frame.unconfirmed):
            self.stop()
        elif self._schedule is None or frame.stamp < self._schedule.since:
            self._schedule = SearchSchedule(frame.stamp, drawn)

    def is_due(self, frame: Frame) -> bool:
        """Whether to search this frame, the newest; the next search counts from this one."""
        if self._schedule is None:
            return False
        waited = frame.stamp - self._schedule.since >= self._p.health.lost_time * 1e9
        lost = frame.health.level is Level.LOST
        return (lost or waited) and self._schedule.is_due(frame)
