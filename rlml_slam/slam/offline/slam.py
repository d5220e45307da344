# SPDX-License-Identifier: Apache-2.0
"""The whole system in one object: inputs in, frames and a map out. Replay and tests drive this."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap, require_contents
from rlml_slam.maps.survey import Survey
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.synchronized_system import SynchronizedSystem
from rlml_slam.slam import conversation as say
from rlml_slam.slam.back_end.back_end import BackEnd, Update
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end_session import FrontEndSession
from rlml_slam.slam.offline.batch_reassociation import BatchReassociation
from rlml_slam.slam.relocalization.pose_test import locate
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.slam.store import map_file
from rlml_slam.slam.system import System
from rlml_slam.types import Frame, Observation, Reflectors


class Slam(SynchronizedSystem):
    """Synchronizer, front end and back end, with the conductor's commands executed at once.

    Answers of searches come ``search_delay`` [s] of stamps late, as they do on a robot.
    """

    def __init__(
        self, params: Parameters, survey: Survey | None = None, search_delay: float = 0.0
    ) -> None:
        super().__init__(params)
        self.session = FrontEndSession(params)
        self.back_end = BackEnd(params, survey)
        self.system = System(params)
        self.batch_reassociation = BatchReassociation(params)
        if survey is not None:  # its frame is not that of the start
            self.batch_reassociation.close()
        self.updates: list[Update] = []
        self.answers: dict[int, say.Answer] = {}
        self.searched: list[Relocation] = []
        self.logs: list[say.Log] = []
        self._params, self._survey = params, survey
        self._path: list[tuple[int, Array]] = []
        self._loaded: BackEnd | None = None
        self._delay = int(search_delay * 1e9)
        self._late: deque[tuple[int, int, Relocation]] = deque()
        self._newest: Frame | None = None  # what the observation came to in the end
        self._executes: Mapping[type, Callable[[Any], None]] = {
            say.StartSession: self._command,
            say.Relocate: self._command,
            say.Correct: self._command,
            say.LocalizeIn: self._command,
            say.MapFrame: self._map_frame,
            say.Search: self._search,
            say.DrawMap: lambda c: self.execute(self.system.on_map_drawn(c.number, self.map())),
            say.TakeMap: self._take_map,
            say.ForgetMap: self._forget_map,
            say.Log: self.logs.append,
            say.Answer: lambda answer: self.answers.update({answer.number: answer}),
        }

    @property
    def front_end(self) -> FrontEnd:
        """The estimator of now; another one where a map is entered or left."""
        return self.session.front_end

    # --- maps ----------------------------------------------------------------------------------

    def use_map(self, saved: SavedMap) -> None:
        """Localise in a map that never changes, instead of making one."""
        self.batch_reassociation.close()
        self.execute(self.system.localize_in(saved))

    def continue_map(self, content: Content) -> None:
        """Go on with a map that was saved, as soon as the robot's place in it is known.

        Raises FileFormatError if the parts of the map do not fit together; then all is as it was.
        """
        loaded = BackEnd(self._params, self._survey)
        map_file.restore(content, loaded)
        self._loaded = loaded
        self.batch_reassociation.close()  # the map knows what this run does not
        first_key = loaded.reflector_graph.next_key
        self.execute(self.system.continue_map(map_file.saved_map(content), first_key))

    def finish(self) -> list[Frame]:
        """Everything that still waits; then the last optimisation."""
        frames = self.process(self.synchronizer.flush())
        entry = self.system.entry
        if self.system.map is None and (entry is None or not entry.is_saved):
            self.back_end.finish()
            if entry is None:
                self._look_back()
        return frames

    def _look_back(self) -> None:
        """Associate the whole run again, and rebuild the map where that changes it."""
        frames = self.batch_reassociation.reassociate(
            self.back_end.trajectory()[1], self.back_end.reflectors()
        )
        if frames:
            self.back_end.reset()
            self.back_end.associations_are_final = True
            for frame in frames:
                self.back_end.add(frame)
            self.back_end.finish()
            self.back_end.associations_are_final = False

    # --- frames --------------------------------------------------------------------------------

    def process(self, observations: Iterable[Observation]) -> list[Frame]:
        """What the synchronizer made of the inputs."""
        frames: list[Frame] = []
        for observation in observations:
            self._deliver_late(observation.stamp)
            record = self.session.process(observation)
            self.synchronizer.follow(record.frame)
            self.batch_reassociation.add(observation, record.frame)
            self._give(record)
            assert self._newest is not None
            if self.system.map is not None:
                self._path.append((self._newest.stamp, self._newest.T_map_base))
            frames.append(self._newest)
        return frames

    def _give(self, record: say.SessionFrame) -> None:
        self._newest = record.frame
        self.execute(self.system.on_frame(record))

    def execute(self, commands: Iterable[say.Command]) -> None:
        """Run the conductor's commands, each with all that its answer asks for."""
        for command in commands:
            run = self._executes.get(type(command))
            if run is not None:  # nothing is published
                run(command)

    def _command(self, command: say.FrontEndCommand) -> None:
        record = self.session.execute(command)
        if record is not None:
            self._give(record)

    def _map_frame(self, command: say.MapFrame) -> None:
        update = self._timed_add(command)
        if update is not None:
            belief = self.back_end.belief() if update.optimized else None
            self.updates.append(update)
            self.execute(
                self.system.on_update(command.session, command.frame.stamp, update, belief)
            )

    def _timed_add(self, command: say.MapFrame) -> Update | None:
        """One frame to the back end; with the time of the processor."""
        began = time.thread_time()
        update = self.back_end.add(command.frame, command.found)
        if update is None:
            return None
        return replace(update, wall_ms=1e3 * (time.thread_time() - began))

    # --- searches and maps as commands -----------------------------------------------------------

    def _search(self, command: say.Search) -> None:
        found = locate(command, self._params)
        self.searched.append(found)
        if self._delay == 0:
            self.execute(self.system.on_search_result(command.number, found))
            return
        now = 0 if self.session.last is None else self.session.last.stamp
        self._late.append((now + self._delay, command.number, found))

    def _deliver_late(self, stamp: int) -> None:
        """Answers of searches that are due by a stamp, or by the end of a clock that jumped."""
        while self._late and not self._late[0][0] - self._delay <= stamp < self._late[0][0]:
            _, number, found = self._late.popleft()
            self.execute(self.system.on_search_result(number, found))

    def _take_map(self, _: say.TakeMap) -> None:
        assert self._loaded is not None
        self.back_end, self._loaded = self._loaded, None

    def _forget_map(self, _: say.ForgetMap) -> None:
        self.back_end.reset()

    # --- the user's requests ---------------------------------------------------------------------

    def reset(self) -> None:
        """Begin at ``map_start_pose``; a map in the making is forgotten."""
        self.execute(self.system.reset(np.array(self._params.node.map_start_pose)))

    def set_localization_mode(self, on: bool) -> None:
        """Localize in the map as it is now, or make a new one. MapError where there is none."""
        if on == (self.system.map is not None):
            return
        if not on:
            self.execute(self.system.make_map())
            return
        self.use_map(require_contents(self.map()))

    # --- products --------------------------------------------------------------------------------

    def map(self) -> SavedMap:
        """The map as it is now, or the one that never changes."""
        if self.system.map is not None:
            return self.system.map
        return SavedMap(self.back_end.reflectors(), self.back_end.occupancy_grid())

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3), map frame, one per frame; optimised where it maps."""
        if self.system.map is not None:
            stamps = np.array([stamp for stamp, _ in self._path], dtype=np.int64)
            return stamps, np.array([pose for _, pose in self._path]).reshape(-1, 3)
        return self.back_end.trajectory()

    def reflectors(self) -> Reflectors:
        """The reflector map."""
        saved = self.system.map
        return self.back_end.reflectors() if saved is None else saved.reflectors

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The map of the scans, None without any."""
        saved = self.system.map
        return self.back_end.occupancy_grid() if saved is None else saved.grid
