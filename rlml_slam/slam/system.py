# SPDX-License-Identifier: Apache-2.0
"""The conductor: sessions, corrections, recovery and saved maps, as events in and commands out.

It has no ROS, no clock, no thread and no file. Replay executes its commands directly, the nodes
publish them. Slow work (a search, drawing the map) is a command with a number; its answer may come
late, and one that was superseded meanwhile changes nothing.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import Update
from rlml_slam.slam.conversation import (
    ANY,
    FIRST_REQUEST,
    MISPLACED,
    RESTARTED,
    Answer,
    Command,
    Correct,
    ForgetMap,
    KeepMap,
    LocalizeIn,
    PublishMap,
    Relocate,
    SessionFrame,
    StartSession,
    TakeMap,
    info,
    warning,
)
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.slam.last_run import LastRun
from rlml_slam.slam.map_entry import MapEntry
from rlml_slam.slam.mapped_frames import MappedFrames, corrections
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.slam.relocalization.relocalize_answer import relocalize_answer
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.slam.requests import Requests
from rlml_slam.slam.searches import Pending, Purpose, Searches
from rlml_slam.types import Belief, Verdict

PAST = 100  # sessions whose frames may still be in a queue
CERTAIN = 1e-6 * np.eye(3)


class System:
    """Decides what front end and back end do; every event returns commands, to be run in order.

    ``map`` is what is localized in, None while a map is made. With an ``entry``, the robot's place
    in a map to be continued is not known, and nothing is mapped. ``mode`` is the number of the
    newest LocalizeIn; ``T_map_local`` (3,) is the graph's newest correction of the session.
    """

    def __init__(self, params: Parameters, first_request: int = FIRST_REQUEST) -> None:
        self.requests = Requests(first_request)
        self.searches = Searches()
        self.recovery = Recovery(params)
        self.map: SavedMap | None = None
        self.entry: MapEntry | None = None
        self.newest: SessionFrame | None = None  # of the frames
        self.session: int | None = None
        self.mode, self.T_map_local = 0, np.zeros(3)
        self.frames = MappedFrames()
        self._patience = params.health.new_session_time
        self._past: deque[int] = deque(maxlen=PAST)
        self._last_run = LastRun()

    def localize_in(
        self, saved: SavedMap, last_pose: Array | None = None, remembers: bool = False
    ) -> list[Command]:
        """Localize in a map that does not change, from ``last_pose`` (3,) if it fits there.

        ``remembers``: the pose is written down for the next start.
        """
        self.map, self.entry = saved, None
        self._last_run = LastRun(last_pose, remembers)
        return [*self._announce_mode(), PublishMap()]

    def make_map(self) -> list[Command]:
        """Make a map; it begins where the robot is, in the axes of a map that was localized in."""
        leaves, self.map = self.map is not None, None
        self._last_run = LastRun()
        out = self._announce_mode()
        return [*out, *self._forget('localization ended')] if leaves else out

    def continue_map(self, saved: SavedMap, first_key: int) -> list[Command]:
        """Go on with a map, loaded and checked, as soon as the robot's place in it is known.

        ``first_key``: the first that no reflector of the map has.
        """
        keep = [] if self.frames.session is None else [KeepMap('another map was loaded')]
        out = self._supersede('another map was loaded')
        self.requests.drop()
        self._forget_graph()
        self.entry, self.frames.next_key = MapEntry(saved, first_key), first_key
        self.frames.has_map = True
        return [*keep, *out, TakeMap(), PublishMap()]

    def reset(self, pose: Array) -> list[Command]:
        """Begin at a pose (3,) of the map; a map in the making is forgotten."""
        out = self._supersede('the system was reset')
        self.entry, self._last_run.pose = None, None
        if self.map is None:
            out.append(self._forget_graph())
        return [*out, self._start(None, pose, CERTAIN)]

    def pause(self, on: bool) -> list[Command]:
        """Leave new measurements out of the map, or take them in again."""
        self.frames.is_paused = on
        return []

    def _announce_mode(self) -> list[Command]:
        out = self._supersede('the map was changed')
        self.requests.drop()
        self.mode = self.requests.new_number()
        return [*out, LocalizeIn(self.mode, self.map)]

    def _supersede(self, why: str) -> list[Command]:
        """No search under way has an effect any more."""
        self.recovery.stop()
        return self.searches.drop_all(why)

    def _forget(self, why: str) -> list[Command]:
        keep: list[Command] = [] if self.frames.session is None else [KeepMap(why)]
        return [*keep, self._forget_graph()]

    def _begin_map(self, why: str) -> list[Command]:
        return [warning(f'{why}: another map begins'), *self._forget(why)]

    def _forget_graph(self) -> ForgetMap:
        self.frames.forget()
        return ForgetMap()

    def _start(self, record: SessionFrame | None, pose: Array, cov: Array) -> StartSession:
        """Begin a session at a pose that a frame has, or that is the robot's now."""
        session, stamp = (ANY, 0) if record is None else (record.session, record.frame.stamp)
        number = self.requests.new_number()
        first_key = 0 if self.entry is None else self.entry.start(number)
        return self.requests.ask(StartSession(number, session, stamp, pose, cov, first_key))

    def on_frame(self, record: SessionFrame) -> list[Command]:
        """The next frame that came, of whatever session."""
        if not self._is_of_mode(record) or record.session in self._past:
            return []  # it was still in the queue
        out: list[Command] = []
        if record.session != self.session:
            if self.requests.is_superseded(record):
                return []
            out += self._begin_session(record)
        self.newest = record
        again = self.requests.follow(record)
        if again is not None:
            out.append(again)
        if self.requests.starts:
            return out
        if self.entry is not None:
            return out + self._search_entry(self.entry, record)
        if self.map is None:
            out += self.frames.add(record)
        if self.map is not None or not self.frames.is_paused:
            out += self._restore(record) + self._recover(record)
        return out + self._last_run.remember(record.frame)

    def is_current(self, record: SessionFrame) -> bool:
        """Whether a frame is of the session that is mapped or localized in."""
        known = self.entry is None and not self.requests.starts
        return known and record.session == self.session and self._is_of_mode(record)

    def _is_of_mode(self, record: SessionFrame) -> bool:
        # a front end that was never given a map makes one
        return record.mode == self.mode or (record.mode == 0 and self.map is None)

    def _begin_session(self, record: SessionFrame) -> list[Command]:
        is_first = self.session is None
        if self.session is not None:
            self._past.append(self.session)
        self.T_map_local = np.zeros(3)
        out = self._supersede('the front end began another session')
        if not self.requests.is_own(record):
            self.requests.drop()
            self._last_run.pose = None
        if self.entry is not None and (self.entry.is_saved or record.request != MISPLACED):
            if record.request in self.entry.requests:
                out.append(info(self.entry.success))
                self.entry, self.frames.jumps = None, True
        elif self.map is None and self.frames.has_map:
            self.entry = None
            if record.request == RESTARTED:
                self.entry = MapEntry(None, self.frames.next_key, self._patience)
                out.append(warning(f'the front end started again: {self.entry.why}'))
            else:
                out += self._begin_map('the front end began elsewhere')
        elif self.map is None and is_first and not self.requests.is_own(record):
            frame = record.frame
            if not np.array_equal(frame.T_map_base, frame.T_local_base):
                # another run of the back end has corrected it: the map begins where it is
                out.append(self._start(record, frame.T_map_base, frame.cov_map))
        self.session = record.session  # last: another thread looks at it
        return out

    def on_update(
        self, session: int, stamp: int, update: Update, belief: Belief | None
    ) -> list[Command]:
        """What the frame at a stamp did, a keyframe now, and the graph's belief after it."""
        if session != self.frames.session:
            return []
        if update.optimized:
            self.T_map_local = update.T_map_local
        return corrections(session, stamp, update, belief)

    def on_solved(self, stamp: int, T_map_local: Array, cov_map: Array | None) -> list[Command]:
        """The graph was solved for a user; its newest keyframe is at a stamp."""
        if self.frames.session is None or self.frames.session != self.session:
            return []
        self.T_map_local = T_map_local
        return [Correct(self.frames.session, stamp, T_map_local, cov_map)]

    def relocalize(self) -> tuple[int, list[Command]]:
        """Find the newest frame anywhere in the map, for a user: the number of the Answer."""
        entry = self.entry
        known, complete = (self.map, True) if entry is None else (entry.saved, entry.is_saved)
        command = self.searches.begin(Purpose.ANSWER, self.newest, known, complete)
        return command.number, [command]

    def _search_entry(self, entry: MapEntry, record: SessionFrame) -> list[Command]:
        if not entry.is_over(record, self.searches) or self.frames.is_paused:
            return entry.search(record, self.searches)
        self.entry, out = None, self._supersede('another map begins')
        out += self._begin_map('the robot was not found in the map')
        return out + self.frames.add(record)

    def _restore(self, record: SessionFrame) -> list[Command]:
        if self.searches.is_pending(Purpose.RESTORE) or not self._last_run.can_be_tested(record):
            return []
        return [self.searches.begin(Purpose.RESTORE, record, self.map)]

    def _recover(self, record: SessionFrame) -> list[Command]:
        self.recovery.follow(record.frame, self.map is None)
        if not self.recovery.is_active:
            self.searches.drop(Purpose.RECOVER)
            return []
        busy = self.searches.is_pending(Purpose.RECOVER, Purpose.RESTORE)
        if busy or self.requests.pending is not None or not self.recovery.is_due(record.frame):
            return []
        known = self.recovery.map if self.map is None else self.map
        return [self.searches.begin(Purpose.RECOVER, record, known, self.map is not None)]

    def on_map_drawn(self, number: int, saved: SavedMap) -> list[Command]:
        """The answer to DrawMap, however late."""
        if self.searches.purpose(number) is Purpose.RECOVER:
            self.recovery.map = saved
        elif self.entry is not None and self.entry.saved is None:
            self.entry.saved = saved
        return self.searches.on_drawn(number, saved)

    def on_search_result(self, number: int, found: Relocation) -> list[Command]:
        """The answer to Search, however late."""
        pending = self.searches.take(number)
        if pending is None:
            return []  # superseded
        record, pose, cov = pending.record, found.pose, found.cov
        if pending.purpose is Purpose.ANSWER:
            return self._answer(number, pending, found)
        assert record is not None
        if pending.purpose is Purpose.RESTORE:
            start, said = self._last_run.test(found)
            return [said] if start is None else [said, self._start(record, *start)]
        if pending.purpose is Purpose.RECOVER:
            self.recovery.why = found.why
        elif self.entry is not None:
            self.entry.on_answer(found.why)
        if found.verdict is not Verdict.UNIQUE or pose is None or cov is None:
            return []
        area, frame = pending.area, record.frame
        if area is not None and not area.contains(pose):
            self.recovery.why = f'{found.why}, but it is too far from where odometry led'
            return []
        if area is not None and frame.observation.points is not None and not self.frames.is_paused:
            self.frames.found = FoundPose(frame.T_local_base, pose, area.size)
            return []  # the graph closes a loop, and nothing jumps
        if self.entry is not None:
            return [self._start(record, pose, cov)]
        go_on = Relocate(self.requests.new_number(), record.session, frame.stamp, pose, cov)
        return [info(f'found again: {found.why}'), self.requests.ask(go_on)]

    def _answer(self, number: int, pending: Pending, found: Relocation) -> list[Command]:
        record, believed = pending.record, None
        if record is not None:
            believed = se2.compose(self.T_map_local, record.frame.T_local_base)
        may_jump = self.map is not None or self.entry is not None
        success, text = relocalize_answer(found, believed, may_jump)
        said = Answer(number, success, text)
        if not (success and may_jump) or record is None or found.pose is None or found.cov is None:
            return [said]
        return [self._start(record, found.pose, found.cov), said]
