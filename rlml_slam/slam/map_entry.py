# SPDX-License-Identifier: Apache-2.0
"""A saved map that is to be continued, while the robot's place in it is not known."""

from __future__ import annotations

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.slam.conversation import GIVEN, SessionFrame
from rlml_slam.slam.relocalization.search_schedule import SearchSchedule
from rlml_slam.slam.searches import Purpose

GIVEN_TIME = 5_000_000_000  # [ns] of stamps in which a pose given by a user is tested


class MapEntry:
    """Decides which frames are searched in the map; ``why`` says how far that has come.

    The map is entered at a pose that was found and is the only one, or at one that a user gave
    and that the frame confirms; never at one that is only assumed. ``first_key`` is the first
    that no reflector of the map has. ``requests`` are the numbers of sessions in the map that were
    asked for.
    """

    def __init__(self, saved: SavedMap, first_key: int) -> None:
        self.saved = saved
        self.first_key = first_key
        self.requests: set[int] = set()
        self.why = 'the robot is searched in the map'
        self._schedule: SearchSchedule | None = None
        self._given_until: int | None = None  # stamp
        self._session: int | None = None

    def next_search(self, record: SessionFrame) -> Purpose | None:
        """What to do with a frame while no search is under way."""
        stamp = record.frame.stamp
        if record.session != self._session:
            self._session = record.session
            self._given_until = stamp + GIVEN_TIME if record.request == GIVEN else None
        if self._given_until is not None and stamp <= self._given_until:
            return Purpose.CONFIRM
        if self._schedule is None or stamp < self._schedule.since:
            self._schedule = SearchSchedule(stamp)
        return Purpose.ENTER if self._schedule.is_due(record.frame) else None
