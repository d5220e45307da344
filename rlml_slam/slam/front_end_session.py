# SPDX-License-Identifier: Apache-2.0
"""The front end's side of the conversation: sessions, and commands that may come late."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import Correction, ReferencePose
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.motion import STILL
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import (
    ANY,
    GIVEN,
    MISPLACED,
    RESTARTED,
    Correct,
    FrontEndCommand,
    LocalizeIn,
    Relocate,
    SessionFrame,
    StartSession,
)
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Frame, Level, Observation

RECENT = 2000  # frames that a command may be of: a search and the graph take their time


class FrontEndSession:
    """Owns a FrontEnd and executes the conductor's commands on it.

    ``session`` is a number from ``new_session``, which no other front end may give; ``request``
    and ``mode`` are those of SessionFrame; ``map`` is what is localized in; ``last`` is the newest
    frame.
    """

    def __init__(self, params: Parameters, new_session: Callable[[], int] | None = None) -> None:
        self._p = params
        self._new_session = new_session
        self.front_end = FrontEnd(params)
        self.session = self._next(0)
        self.request, self.mode = RESTARTED, 0
        self.map: SavedMap | None = None
        self.last: Frame | None = None
        self._observation: Observation | None = None  # that of ``last``
        self._number = 0  # of the newest request
        self._lost_since: int | None = None  # stamp of the first of the lost frames
        # stamp -> T_local_base (3,) and its covariance (3, 3)
        self._recent: OrderedDict[int, tuple[Array, Array]] = OrderedDict()

    def _next(self, session: int) -> int:
        return session + 1 if self._new_session is None else self._new_session()

    def process(self, observation: Observation) -> SessionFrame:
        """The frame of one observation."""
        frame = self.last = self.front_end.process(observation)
        self._observation = observation
        self._recent[frame.stamp] = (frame.T_local_base, frame.cov_local)
        if len(self._recent) > RECENT:
            self._recent.popitem(last=False)
        if not is_lost(frame):
            self._lost_since = None
        elif self._lost_since is None:
            self._lost_since = frame.stamp
        return SessionFrame(self.session, frame, self.request, self.mode)

    def restart(self, misplaced: bool = False) -> None:
        """Begin at ``map_start_pose``: the clock jumped back, or a sensor was ``misplaced``."""
        request = MISPLACED if misplaced else RESTARTED
        self._begin(np.array(self._p.node.map_start_pose), np.zeros((3, 3)), request)

    def start_at(self, stamp: int, pose: Array, cov: Array) -> Array:
        """Begin where a user says (3,), (3, 3); the stamp of a frame says when that was.

        Returns the pose (3,) of now.
        """
        pose, cov = self._now(stamp, pose, cov)
        self._begin(pose, cov, GIVEN)
        return pose

    def execute(self, command: FrontEndCommand) -> SessionFrame | None:
        """Carry out a command; what is of another session, or superseded, changes nothing.

        Where a session begins at the newest observation, that is the first of the session: its
        frame is returned.
        """
        if isinstance(command, Correct):
            self._correct(command)
        elif isinstance(command, LocalizeIn):
            if command.number != self.mode:
                self._localize_in(command)
        elif self._is_meant(command):
            self._number = command.number
            if isinstance(command, StartSession):
                return self._start(command)
            self._relocate(command)
        return None

    def _is_meant(self, command: StartSession | Relocate) -> bool:
        if command.number <= self._number:
            return False
        known = command.session == self.session and command.stamp in self._recent
        return command.session == ANY or known

    def _start(self, command: StartSession) -> SessionFrame | None:
        stamp = None if command.session == ANY else command.stamp
        pose, cov = self._now(stamp, command.pose, command.cov)
        self._begin(pose, cov, command.number)
        self.front_end.tracks.next_key = command.first_key
        newest = self._observation
        if newest is None or newest.stamp != stamp:
            return None
        return self.process(dataclasses.replace(newest, motion=STILL))

    def _relocate(self, command: Relocate) -> None:
        self.request = command.number
        if self._lost_since is None or command.stamp < self._lost_since:
            return  # it has found itself since
        pose, cov = self._now(command.stamp, command.pose, command.cov)
        self.front_end.relocate(pose, cov)
        # no motion leads from the frames before to those that come
        self._recent.clear()

    def _localize_in(self, command: LocalizeIn) -> None:
        before, self.map, self.mode = self.map, command.map, command.number
        # the first command of a back end, whose numbers may be smaller than those of another run
        self._number = command.number
        if before is None and self.map is None:
            return  # it makes a map already
        mode = 'mapping' if self.map is None else 'localization'
        node = dataclasses.replace(self._p.node, mode=mode)
        self.front_end = FrontEnd(dataclasses.replace(self._p, node=node))
        if self.last is None:
            self.restart()
            self.request = command.number
        else:
            self._begin(self.last.T_map_base, self.last.cov_map, command.number)

    def _correct(self, command: Correct) -> None:
        """Take over what the graph knows of a frame of this session."""
        then = self._recent.get(command.stamp)
        if command.session != self.session or then is None:
            return
        front_end = self.front_end
        front_end.forget(command.removed)
        if command.T_map_local is None:
            return
        known = None if command.cov_map is None else ReferencePose(*then, command.cov_map)
        front_end.correct(command.T_map_local, known)
        belief = command.belief
        if belief is None:
            return
        front_end.forget(belief.removed)
        if command.stamp == front_end.newest and front_end.contradicts(belief):
            front_end.adopt(belief)

    def _now(self, stamp: int | None, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (3,), (3, 3) in the map at a stamp, moved on by what the robot drove since."""
        then = None if stamp is None else self._recent.get(stamp)
        if then is None or stamp == self.front_end.newest:
            return pose, cov
        T_map_local = se2.compose(pose, se2.inverse(then[0]))
        correction = Correction(T_map_local, ReferencePose(*then, cov))
        return correction.apply(*self.front_end.local_belief)

    def _begin(self, pose: Array, cov: Array, request: int) -> None:
        self.front_end.reset(pose, cov)
        if self.map is not None:
            self.front_end.use_map(self.map.reflectors, self.map.grid)
        self._recent.clear()
        self._lost_since = None
        self.session, self.request = self._next(self.session), request


def is_lost(frame: Frame) -> bool:
    """Whether what was seen contradicts the map or has not confirmed the pose yet."""
    return frame.health.level is Level.LOST or frame.unconfirmed
