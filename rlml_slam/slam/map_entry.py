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
    for a map in the making: where the robot is not found in it, another one begins. It counts for
    each session, and where a search was answered.
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
        self._is_answered = False
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

    def start(self, number: int) -> int:
        """A session in the map is asked for by this number; the key of its first new reflector."""
        self.requests.add(number)
        self._since, self._is_answered = None, False  # where the request is lost
        return self.first_key

    def on_answer(self, why: str) -> None:
        """What a search has found."""
        self.why, self._is_answered = why, True

    def is_over(self, record: SessionFrame, searches: Searches) -> bool:
        """Whether the robot has been searched for longer than the patience."""
        stamp = record.frame.stamp
        if record.session != self._session:
            self._begin_session(record)
        if self._since is None or stamp < self._since:
            self._since = stamp
        late = stamp - self._since > self._patience and not self._is_given(stamp)
        return late and self._is_answered and not (self.is_saved or _is_searched(searches))

    def search(self, record: SessionFrame, searches: Searches) -> list[Command]:
        """The search of a frame, none while another one is under way."""
        if _is_searched(searches):
            return []
        purpose = self._purpose(record)
        if purpose is None:
            return []
        return [searches.begin(purpose, record, self.saved, self.is_saved)]

    def _begin_session(self, record: SessionFrame) -> None:
        self._session, self._since, self._is_answered = record.session, None, False
        is_given = record.request == GIVEN
        self._given_until = record.frame.stamp + GIVEN_TIME if is_given else None

    def _is_given(self, stamp: int) -> bool:
        return self._given_until is not None and stamp <= self._given_until

    def _purpose(self, record: SessionFrame) -> Purpose | None:
        if self._is_given(record.frame.stamp):
            return Purpose.CONFIRM
        if self._schedule is None or record.frame.stamp < self._schedule.since:
            self._schedule = SearchSchedule(record.frame.stamp)
        return Purpose.ENTER if self._schedule.is_due(record.frame) else None


def _is_searched(searches: Searches) -> bool:
    return searches.is_pending(Purpose.ENTER, Purpose.CONFIRM)
