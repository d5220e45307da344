# SPDX-License-Identifier: Apache-2.0
"""A map that is to be continued, while the robot's place in it is not known."""

from __future__ import annotations

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.slam.conversation import GIVEN, Command, SessionFrame
from rlml_slam.slam.relocalization.search_schedule import SearchSchedule
from rlml_slam.slam.searches import Purpose, Searches

GIVEN_TIME = 5_000_000_000  # [ns] of stamps in which a pose given by a user is tested


class MapEntry:
    """Decides which frames are searched in the map; ``why`` says how far that has come.

    The map is entered at a pose that was found and is the only one, or at one that a user gave
    and that the frame confirms; never at one that is only assumed. ``saved`` is None until a map
    in the making is drawn. ``first_key`` is the first that no reflector of the map has.
    ``requests`` are the numbers of sessions in the map that were asked for. A ``patience`` [s] is
    for a map in the making: where the robot is not found in it, another one begins.
    """

    def __init__(
        self, saved: SavedMap | None, first_key: int, patience: float | None = None
    ) -> None:
        self.saved = saved
        self.first_key = first_key
        self.requests: set[int] = set()
        self.why = 'the robot is searched in the map'
        self.is_saved = patience is None
        self._patience = 0 if patience is None else round(1e9 * patience)
        self._since: int | None = None  # stamp
        self._schedule: SearchSchedule | None = None
        self._given_until: int | None = None  # stamp
        self._session: int | None = None

    @property
    def problem(self) -> str:
        """Why poses are not in the map."""
        if self.is_saved:
            return f'not yet in the saved map: {self.why}'
        return f'not yet in the map: {self.why}'

    @property
    def success(self) -> str:
        """What to say when the map is entered."""
        return f'the {"saved map" if self.is_saved else "map"} is continued: {self.why}'

    def is_over(self, stamp: int) -> bool:
        """Whether the robot has been searched for longer than the patience."""
        if self._since is None or stamp < self._since:
            self._since = stamp
        return not self.is_saved and stamp - self._since > self._patience

    def search(self, record: SessionFrame, searches: Searches) -> list[Command]:
        """The search of a frame, none while another one is under way."""
        purpose = (
            None if searches.is_pending(Purpose.ENTER, Purpose.CONFIRM) else self._next(record)
        )
        if purpose is None:
            return []
        return [searches.begin(purpose, record, self.saved, self.is_saved)]

    def _next(self, record: SessionFrame) -> Purpose | None:
        stamp = record.frame.stamp
        if record.session != self._session:
            self._session = record.session
            self._given_until = stamp + GIVEN_TIME if record.request == GIVEN else None
        if self._given_until is not None and stamp <= self._given_until:
            return Purpose.CONFIRM
        if self._schedule is None or stamp < self._schedule.since:
            self._schedule = SearchSchedule(stamp)
        return Purpose.ENTER if self._schedule.is_due(record.frame) else None
