# SPDX-License-Identifier: Apache-2.0
"""Requests to the front end: their numbers, and the one that is not answered yet."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from rlml_slam.slam.conversation import ANY, FIRST_REQUEST, Relocate, SessionFrame, StartSession

Request = TypeVar('Request', bound=StartSession | Relocate)

PATIENCE = 5_000_000_000  # [ns] of stamps after which a request counts as lost


class Requests:
    """Numbers for requests, from ``first`` on; ``pending`` is the one that frames do not show yet.

    Numbers must differ from those that another run of the back end gave to the same front end.
    """

    def __init__(self, first: int = FIRST_REQUEST) -> None:
        self._first = max(first, FIRST_REQUEST)
        self._newest = self._first - 1
        self._since: int | None = None  # stamp of the first frame after the pending request
        self.pending: StartSession | Relocate | None = None

    def new_number(self) -> int:
        """The next number."""
        self._newest += 1
        return self._newest

    def ask(self, command: Request) -> Request:
        """The command, which is pending from now on in the place of an older one."""
        self.pending, self._since = command, None
        return command

    def drop(self) -> None:
        """Whether the pending request is answered does not matter any more."""
        self.pending = None

    @property
    def starts(self) -> bool:
        """Whether a session is to begin, so that frames of the one before mean nothing."""
        return isinstance(self.pending, StartSession)

    def is_own(self, record: SessionFrame) -> bool:
        """Whether a frame's newest request is one of these numbers."""
        return self._first <= record.request <= self._newest

    def is_superseded(self, record: SessionFrame) -> bool:
        """Whether a frame's session was begun by a request that a newer one replaces."""
        pending = self.pending
        if not isinstance(pending, StartSession) or not self.is_own(record):
            return False
        if pending.session not in (ANY, record.session):
            self.pending = None  # the front end had begun this session before, and ignores it
            return False
        return record.request < pending.number

    def follow(self, record: SessionFrame) -> StartSession | Relocate | None:
        """Look whether a frame answers the pending request; one to be made again, if it got lost.

        A request about a place that was found is dropped instead: a later frame is searched.
        """
        pending, stamp = self.pending, record.frame.stamp
        if pending is None:
            return None
        if self._since is None:
            self._since = stamp
        if record.request == pending.number:
            self.pending = None
        elif not 0 <= stamp - self._since <= PATIENCE:
            self.pending = None
            if pending.session == ANY:
                return self.ask(replace(pending, number=self.new_number()))
        return None
