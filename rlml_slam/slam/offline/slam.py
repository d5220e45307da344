# SPDX-License-Identifier: Apache-2.0
"""The whole system in one object: inputs in, frames and a map out. Replay and tests drive this."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.maps.survey import Survey
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.synchronized_system import SynchronizedSystem
from rlml_slam.slam.back_end.back_end import BackEnd, Update
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.offline.back_end_process import BackEndProcess
from rlml_slam.slam.offline.batch_reassociation import BatchReassociation
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.slam.store import map_file
from rlml_slam.types import (
    Frame,
    Level,
    Observation,
    Reflectors,
    Verdict,
)

AHEAD = 1000  # frames that the front end may be ahead of the back end


class Slam(SynchronizedSystem):
    """Synchronizer, front end and back end.

    With ``parallel`` the back end works in a process of its own, up to AHEAD frames behind, and
    frames come later by as many; they are the same to the last bit. The front end's local frame
    depends on nothing that the back end says, as long as there are no reflectors and the robot is
    not lost: with the first reflector both take turns for good, and at a lost frame once. The
    front end's times in milliseconds are then those of the processor, without the waits for one
    another, as the back end's are in any case.
    """

    def __init__(
        self, params: Parameters, parallel: bool = False, survey: Survey | None = None
    ) -> None:
        super().__init__(params)
        self.front_end = FrontEnd(params)
        self.back_end = BackEnd(params, survey)
        self.recovery = Recovery(params)
        self.batch_reassociation = BatchReassociation(params)
        if survey is not None:  # its frame is not that of the start
            self.batch_reassociation.close()
        self.updates: list[Update] = []
        self._params = params
        self._saved: SavedMap | None = None
        self._begin_in: SavedMap | None = None
        self._path: list[tuple[int, Array]] = []
        self._parallel = parallel
        self._apart: BackEndProcess | None = None
        self._pending: deque[tuple[Frame, float, Array]] = deque()

    def use_map(self, saved: SavedMap) -> None:
        """Localise in a map that never changes, instead of making one."""
        self._saved = saved
        self.front_end.use_map(saved.reflectors, saved.grid)

    def continue_map(self, content: Content) -> None:
        """Go on with a map that was saved: the first frame looks for its place in it.

        Where that is not told, it is taken to be at ``map_start_pose``. Raises FileFormatError if
        the parts of the map do not fit together.
        """
        self.batch_reassociation.close()  # the map knows what this run does not
        map_file.restore(content, self.back_end)
        self._begin_in = map_file.saved_map(content)

    def _enter(self, observation: Observation) -> None:
        """Begin where an observation was made in the map to go on with."""
        assert self._begin_in is not None
        found = localize_globally(
            self._begin_in.grid, self._begin_in.reflectors, observation, self._params
        )
        if found.verdict is Verdict.UNIQUE and found.pose is not None and found.cov is not None:
            self.front_end.reset(found.pose, found.cov)
        # keys of the front end and of the map must not mean different reflectors
        self.front_end.tracks.next_key = self.back_end.reflector_graph.next_key
        self._begin_in = None

    def finish(self) -> list[Frame]:
        """Everything that still waits; then the last optimisation."""
        frames = self.process(self.synchronizer.flush()) + self._take_turns()
        if self._saved is None:
            self.back_end.finish()
            self._look_back()
        return frames

    def _look_back(self) -> None:
        """Make the map again from what the whole run tells, where that is more."""
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

    def process(self, observations: Iterable[Observation]) -> list[Frame]:
        """What the sequencer made of the inputs."""
        frames = []
        for observation in observations:
            if self._saved is not None or observation.detections:
                frames += self._take_turns()
            began = time.thread_time()
            enters = self._begin_in is not None
            if enters:
                self._enter(observation)
            frame = self.front_end.process(observation)
            if enters:  # no motion leads here from where the map was left
                frame = replace(frame, jumped=True)
            self.batch_reassociation.add(observation, frame)
            if self._saved is not None:
                self._path.append((frame.stamp, frame.T_map_base))
                frames.append(frame)
            elif self._parallel:
                spent = 1e3 * (time.thread_time() - began)
                self._apart = self._apart or BackEndProcess(self.back_end, _add)
                self._apart.add(frame)
                late = self.front_end.late(observation.stamp_sigma)
                self._pending.append((frame, spent, frame.cov_local + late))
                is_lost = frame.health.level is Level.LOST or frame.unconfirmed
                frames += self._settle(0 if is_lost else AHEAD)
            else:
                if self._take_over(_add(self.back_end, frame)):
                    self._believe()
                frames.append(frame)
            found = self.recovery.look(frame, self.map, self._saved is not None)
            if found is not None and found.pose is not None and found.cov is not None:
                self.front_end.relocate(found.pose, found.cov)
        return frames

    def _take_turns(self) -> list[Frame]:
        """End the back end's process, if there is one; the frames that waited for it."""
        frames = self._settle(0)
        if self._apart is not None:
            self.back_end = self._apart.bring_home()
            self._apart = None
        self._parallel = False
        return frames

    def _settle(self, most: int) -> list[Frame]:
        """The oldest of the frames that wait for the back end, so that ``most`` are left."""
        frames = []
        while len(self._pending) > most:
            assert self._apart is not None
            frame, spent, cov = self._pending.popleft()
            T_map_base, cov_map = self.front_end.in_map(frame.T_local_base, cov)
            frames.append(replace(frame, T_map_base=T_map_base, cov_map=cov_map, wall_ms=spent))
            self._take_over(self._apart.update())
        return frames

    def _take_over(self, update: Update | None) -> bool:
        """Give the front end the correction of an update; whether there is one."""
        if update is None:
            return False
        self.updates.append(update)
        self.front_end.forget(update.removed)
        if update.optimized:
            self.front_end.correct(update.T_map_local, update.known)
        return update.optimized

    def _believe(self) -> None:
        """Let the front end go on from the graph where the graph contradicts it."""
        belief = self.back_end.belief()
        if belief is not None and self.front_end.contradicts(belief):
            self.front_end.adopt(belief)

    def map(self) -> SavedMap:
        """The map as it is now, or the one that never changes."""
        if self._saved is not None:
            return self._saved
        if self._apart is not None:
            return self._apart.map()
        return SavedMap(self.back_end.reflectors(), self.back_end.occupancy_grid())

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3), map frame, one per frame; optimised where it maps."""
        if self._saved is not None:
            stamps = np.array([stamp for stamp, _ in self._path], dtype=np.int64)
            return stamps, np.array([pose for _, pose in self._path]).reshape(-1, 3)
        return self.back_end.trajectory()

    def reflectors(self) -> Reflectors:
        """The reflector map."""
        return self._saved.reflectors if self._saved is not None else self.back_end.reflectors()

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The map of the scans, None without any."""
        if self._saved is not None:
            return self._saved.grid
        return self.back_end.occupancy_grid()


def _add(back_end: BackEnd, frame: Frame) -> Update | None:
    """One frame to the back end, in whatever process; with the time of the processor."""
    began = time.thread_time()
    update = back_end.add(frame)
    if update is None:
        return None
    return replace(update, wall_ms=1e3 * (time.thread_time() - began))
