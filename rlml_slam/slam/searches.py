# SPDX-License-Identifier: Apache-2.0
"""Searches that are under way, by number: a late or superseded answer is recognised."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.slam.conversation import Answer, Command, DrawMap, Search, SessionFrame
from rlml_slam.slam.search_area import SearchArea, search_area


class Purpose(Enum):
    """What a search is for."""

    ENTER = 'to enter a map that is to be continued'
    CONFIRM = 'to test the pose that a user gave'
    RECOVER = 'to find a lost robot'
    RESTORE = 'to test the pose of the last run'
    ANSWER = 'to answer a user'


@dataclass(frozen=True)
class Pending:
    """A search under way: of which frame, None where there was none yet, and where.

    The map is ``complete``, or drawn while it is made. In a map in the making, what fits outside
    of the ``area`` may be a twin of what is not mapped.
    """

    purpose: Purpose
    record: SessionFrame | None
    area: SearchArea | None
    complete: bool


class Searches:
    """``take`` gives what a number stands for, once."""

    def __init__(self) -> None:
        self._newest = 0
        self._pending: dict[int, Pending] = {}

    def is_pending(self, *purposes: Purpose) -> bool:
        """Whether a search for one of the purposes is under way."""
        return any(p.purpose in purposes for p in self._pending.values())

    def begin(
        self,
        purpose: Purpose,
        record: SessionFrame | None,
        saved: SavedMap | None,
        complete: bool = True,
    ) -> Search | DrawMap:
        """The command for a search in a map; without one, to draw the map in the making first."""
        number = self._newest = self._newest + 1
        area = None
        is_unfinished = saved is None or not complete
        if purpose is Purpose.RECOVER and is_unfinished and record is not None:
            area = search_area(record.frame)
        self._pending[number] = Pending(purpose, record, area, complete)
        if saved is None:
            return DrawMap(number)
        return self._search(number, saved, complete)

    def on_drawn(self, number: int, saved: SavedMap) -> list[Command]:
        """The search that the map was drawn for."""
        pending = self._pending.get(number)
        return [] if pending is None else [self._search(number, saved, pending.complete)]

    def _search(self, number: int, saved: SavedMap, complete: bool) -> Search:
        pending = self._pending[number]
        frame = None if pending.record is None else pending.record.frame
        if frame is None:
            return Search(number, None, saved, complete)
        given = frame if pending.purpose is Purpose.CONFIRM else None
        return Search(number, frame.observation, saved, complete, given, pending.area)

    def take(self, number: int) -> Pending | None:
        """What is under way with this number, and no longer from now on; None if superseded."""
        return self._pending.pop(number, None)

    def purpose(self, number: int) -> Purpose | None:
        """What a number stands for, None if superseded."""
        pending = self._pending.get(number)
        return None if pending is None else pending.purpose

    def drop(self, *purposes: Purpose) -> None:
        """Their answers will change nothing."""
        self._pending = {n: p for n, p in self._pending.items() if p.purpose not in purposes}

    def drop_all(self, why: str) -> list[Command]:
        """No answer will change anything; users who wait for one get ``why``."""
        waiting = [n for n, p in self._pending.items() if p.purpose is Purpose.ANSWER]
        self._pending.clear()
        return [Answer(number, False, f'not found: {why}') for number in waiting]
