# SPDX-License-Identifier: Apache-2.0
"""The live back end: a worker thread owns graph and conductor, and executes its commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np

from rlml_slam.errors import MapError
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.correction_smoothing import SmoothedCorrection
from rlml_slam.ros.back_end.last_pose import LastPose
from rlml_slam.ros.back_end.map_archive import MapArchive
from rlml_slam.ros.back_end.map_journal import MapJournal
from rlml_slam.ros.back_end.map_topics import MapTopics
from rlml_slam.ros.back_end.map_transform import MapTransform
from rlml_slam.ros.back_end.searcher import Searcher
from rlml_slam.ros.back_end.worker import Worker
from rlml_slam.ros.diagnostics import map_id
from rlml_slam.ros.map_publisher import MapPublisher
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.slam import conversation as say
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import state_counts
from rlml_slam.slam.system import System
from rlml_slam.types import Frame

MAX_BACKLOG = 20  # frames behind which pictures of the map are left out
IDLE = 0.3  # [s] of the wall clock without a frame, after which the map is brought up to date


class Mapper:
    """Frames in; commands for the front end, the map and map to odom out.

    ``command`` takes the commands for a front end in the same process, from any thread; without
    it they are published.
    """

    def __init__(
        self,
        node: Any,
        params: Parameters,
        command: Callable[[say.FrontEndCommand], None] | None = None,
        search_delay: float | None = None,
    ) -> None:
        self._p = params
        self._logger = node.get_logger()
        # by which names of files differ between robots: that of the namespace, '' without one
        self.robot = node.get_namespace().rstrip('/').replace('/', '.')
        self.archive = MapArchive(params, self._logger)
        self.journal = MapJournal(self.archive.folder, params, self._logger)
        self._is_kept = True  # whether what KeepMap asked for was written
        self.system = System(params, int(time.time()))
        survey = self.archive.folder.survey(params.back_end.survey)
        self.new_back_end = lambda: BackEnd(params, survey)
        self.back_end = self.new_back_end()
        # checked, and about to take the place of the graph
        self.loaded: tuple[BackEnd, Content] | None = None
        self.last_pose: LastPose | None = None
        self._survey_found = False
        self.answers: dict[int, Future[say.Answer]] = {}
        guard = guard_of(node)
        self._report = lambda error: guard.report('frames', error)
        self.worker = Worker(self._report)
        self.searcher = Searcher(params, self._on_search_result, self._report, search_delay)
        self.products = MapPublisher(node, params.node)
        self._newest: Frame | None = None
        self._session: int | None = None  # of the newest frame that came
        self._heard = 0.0
        self._ended = False
        self._topics = MapTopics(node, params.node)
        self._command = command or self._topics.send
        steady = SmoothedCorrection(params.back_end, self._topics.jump)
        self.transform = MapTransform(node, params.node, steady.follow)
        self._executes = self._table()

    def _table(self) -> Mapping[type, Callable[[Any], None]]:
        return {
            say.StartSession: self._command,
            say.Relocate: self._command,
            say.LocalizeIn: self._command,
            say.Correct: self._correct,
            say.MapFrame: self._map_frame,
            say.Search: self.searcher.submit,
            say.DrawMap: lambda c: self.execute(
                self.system.on_map_drawn(c.number, self.current())
            ),
            say.KeepMap: self._keep_map,
            say.ForgetMap: self._forget_map,
            say.TakeMap: self._take_map,
            say.PublishMap: lambda _: self.publish_map(),
            say.RememberPose: self._remember_pose,
            say.Log: self._log,
            say.Answer: lambda c: self.answers.pop(c.number).set_result(c),
        }

    @property
    def stamp(self) -> int:
        """Stamp of the newest frame, 1 before the first."""
        newest = self._newest
        return newest.stamp if newest is not None else 1

    # --- frames --------------------------------------------------------------------------------

    def add(self, record: say.SessionFrame) -> None:
        """Give one frame to the worker."""
        if self._session not in (None, record.session):
            self.transform.restart()
        self._session = record.session
        self._heard = time.monotonic()
        goes_on = self.system.session in (None, record.session) or record.request != say.RESTARTED
        if self.system.entry is None and goes_on:
            self.transform.follow(record.frame)
        self.worker.submit(lambda: self._add(record))

    def _add(self, record: say.SessionFrame) -> None:
        self.execute(self.system.on_frame(record))
        if not self.system.is_current(record):
            return
        self._newest = record.frame
        due = self.system.map is None and self.products.is_due(record.frame.stamp)
        if due and self.worker.backlog < MAX_BACKLOG:
            self.publish_map()

    def submit(self, commands: Iterable[say.Command]) -> None:
        """Let the worker run the conductor's commands."""
        self.worker.submit(lambda: self.execute(commands))

    def execute(self, commands: Iterable[say.Command]) -> None:
        """In the worker: run the conductor's commands."""
        for command in commands:
            self._executes[type(command)](command)
        self._topics.show_entry('; '.join(self.entry_problems()))

    def _map_frame(self, command: say.MapFrame) -> None:
        frame = command.frame
        update = self.back_end.add(frame, command.found)
        self.journal.add(frame, update is not None, command.found)
        if update is None:
            return
        self.archive.unsaved += 1
        self._topics.update(frame.stamp, self.back_end.graph.poses[update.keyframe, :2], update)
        belief = None
        if update.optimized:
            self._report_survey()
            belief = self.back_end.belief()
        self.execute(self.system.on_update(command.session, frame.stamp, update, belief))

    def _correct(self, command: say.Correct) -> None:
        self._command(command)
        if command.T_map_local is not None:
            self._topics.correct(command.stamp, command.T_map_local, command.cov_map)

    def _report_survey(self) -> None:
        """Say so once when the map has entered the frame of the survey."""
        survey_frame = self.back_end.survey_frame
        found = survey_frame is not None and survey_frame.found
        if survey_frame is not None and found and not self._survey_found:
            self._logger.info(f'the map has the frame of the survey: {survey_frame.why}')
        self._survey_found = found

    def _on_search_result(self, number: int, found: Any) -> None:
        self.worker.submit(lambda: self.execute(self.system.on_search_result(number, found)))

    def _log(self, command: say.Log) -> None:
        if command.severity is say.Severity.WARNING:
            self._logger.warning(command.text)
        else:
            self._logger.info(command.text)

    # --- the map -------------------------------------------------------------------------------

    def _keep_map(self, command: say.KeepMap) -> None:
        grid = self.products.grid(self.back_end)
        self._is_kept = self.archive.keep(self.back_end, grid, command.reason)

    def _forget_map(self, _: say.ForgetMap) -> None:
        self.back_end.reset()
        self._begin_map(None)

    def _take_map(self, _: say.TakeMap) -> None:
        assert self.loaded is not None
        (self.back_end, base), self.loaded = self.loaded, None
        self._begin_map(base)

    def _begin_map(self, base: Content | None) -> None:
        self.archive.begin()
        self.journal.restart(base, keep=not self._is_kept)
        self._is_kept = True
        self.products.restart()
        self._topics.correct(self.stamp, np.zeros(3))
        self._newest = None

    def _remember_pose(self, command: say.RememberPose) -> None:
        if self.last_pose is None:
            return
        try:
            self.last_pose.remember(command.frame)
        except MapError as e:
            self._logger.warning(f'{e}')
            self.last_pose = None  # where it cannot be written now, it cannot later

    def current(self) -> SavedMap:
        """In the worker: the map as it is now."""
        if self.system.map is not None:
            return self.system.map
        return SavedMap(self.back_end.reflectors(), self.products.grid(self.back_end))

    def publish_map(self) -> None:
        """In the worker: send map, trajectory, reflectors and graph now."""
        self.products.publish(self.back_end, self.system.map, self.stamp)

    def settle(self) -> None:
        """Now and then: show that it runs, write the journal, and send the map in a silence."""
        self._topics.show_alive()
        if self.journal.is_due:
            self.worker.submit(self.journal.write)
        silent = time.monotonic() - self._heard >= IDLE
        if silent and self.worker.backlog == 0 and self._is_behind():
            self.worker.submit(lambda: self.publish_map() if self._is_behind() else None)

    def _is_behind(self) -> bool:
        known = self.system.map is None and self._newest is not None
        return known and self.products.stamp < self.stamp

    def send_transform(self) -> None:
        """Publish map to odom once more; it waits for no job of the worker."""
        self.worker.check()
        self.searcher.worker.check()
        if self.system.entry is None:
            self.transform.repeat()

    def close(self) -> None:
        """Save what was mapped, behind the running job; then the running search may end."""
        self.journal.ends = True
        self.worker.close()
        if not self._ended:
            self._ended = True
            saved = self.archive.autosave(self.back_end, self.products.grid(self.back_end))
            self.journal.close(keep=not saved)
        self.searcher.close()

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        back_end, entry = self.back_end, self.system.entry
        survey_frame = back_end.survey_frame
        return {
            'keyframes': len(back_end.graph.poses),
            'edges': len(back_end.graph.edges),
            'closures accepted': back_end.loop_closer.tried[True],
            'closures rejected': back_end.loop_closer.tried[False],
            **state_counts(back_end.loop_closer.records),
            'map id': map_id(entry.saved if entry and entry.is_saved else self.system.map),
            **({} if entry is None else {'map not entered': entry.why}),
            **({} if survey_frame is None else {'survey': survey_frame.why}),
            'constellations not searched': back_end.constellation_search.not_searched,
            'frames waiting for the worker': self.worker.backlog,
        }

    def problems(self) -> tuple[str, ...]:
        """What /diagnostics have to say of the files, and of the robot's place in them."""
        unwritten = (self.journal.problem,) if self.journal.problem else ()
        return (*unwritten, *self.entry_problems())

    def entry_problems(self) -> tuple[str, ...]:
        """Why poses are not in the saved map that is to be continued."""
        entry = self.system.entry
        return () if entry is None else (entry.problem,)
