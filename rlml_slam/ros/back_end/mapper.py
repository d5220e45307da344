# SPDX-License-Identifier: Apache-2.0
"""The live back end: a worker thread owns the graph and publishes what changes by each frame."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.motion import SECOND
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.continued_map import Continued
from rlml_slam.ros.back_end.correction_smoothing import SmoothedCorrection
from rlml_slam.ros.back_end.last_pose import LastPose
from rlml_slam.ros.back_end.map_folder import MapFolder
from rlml_slam.ros.back_end.map_topics import MapTopics
from rlml_slam.ros.back_end.worker import Worker
from rlml_slam.ros.codecs.belief_message import StampedBelief
from rlml_slam.ros.codecs.frame_messages import Record
from rlml_slam.ros.map_publisher import MapPublisher
from rlml_slam.ros.odom_frame import OdomFrame
from rlml_slam.ros.tf import TransformPublisher
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import describe
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.slam.store import map_file
from rlml_slam.types import Frame, Verdict

MAX_BACKLOG = 20  # frames behind which pictures of the map are left out
IDLE = 0.3  # [s] of the wall clock without a frame, after which the map is brought up to date
SAME_PLACE, SAME_TURN = 0.3, 0.1  # [m], [rad] of a scan from where it is believed
ADVICE = (
    'drive to a place of the map that looks like no other and call again, or tell the pose on '
    'initialpose'
)


class Mapper:
    """Frames in; correction, map and map to odom out.

    While it localizes (``saved`` is there), the graph is left alone: the map that was loaded, or
    made before, is published and never changes.
    """

    def __init__(self, node: Any, params: Parameters) -> None:
        self._p = params
        self._logger = node.get_logger()
        self.folder = MapFolder(params.node.map_directory)
        self.saved: SavedMap | None = None
        self._loaded: SavedMap | None = None  # the last one that came from the folder
        self._last_pose: LastPose | None = None
        if params.node.mode == 'localization':
            self._load(params.node.map_file_name)
        self.back_end = BackEnd(params, self.folder.survey(params.back_end.survey))
        self._continued: Continued | None = None
        self._in_plant = False
        self.recovery = Recovery(params)
        self.worker = Worker()
        self.products = MapPublisher(node, params.node)
        self._odom = OdomFrame()
        self._newest: Frame | None = None
        self._session: int | None = None  # of the newest frame that came
        self._mapped: int | None = None  # and of the newest that the worker has seen
        self._told: int | None = None  # session of a lost front end that knows its place by now
        self._sent = 0
        self._written: int | None = None  # stamp of the newest keyframe that is in a file
        self._heard = 0.0
        self._tf = TransformPublisher(node)
        self._topics = MapTopics(node, params.node)
        self._steady = SmoothedCorrection(params.back_end, self._topics.jump)
        if self.saved is not None:
            self.worker.submit(self._use_saved)
        elif params.node.continue_map:
            whole = self.folder.whole(params.node.map_file_name)
            if whole.exists():
                self._continue(params.node.map_file_name)
            else:
                self._logger.warning(f'{whole} is not there to go on with: a map is begun')

    @property
    def stamp(self) -> int:
        """Stamp of the newest frame, 1 before the first."""
        newest = self._newest  # once: the worker forgets it when everything begins anew
        return newest.stamp if newest is not None else 1

    def add(self, record: Record) -> None:
        """Give one frame to the worker; another session of the front end begins another map."""
        if self._session not in (None, record.session):
            if self.saved is None and not self._enters:
                self._logger.warning('the front end began anew, and so does the map')
            self.worker.submit(self._begin_session)
            self._odom.restart()
        self._session = record.session
        self._heard = time.monotonic()
        self._odom.follow(record.frame)
        self.worker.submit(lambda: self._add(record))

    def _add(self, record: Record) -> None:
        frame = self._newest = record.frame
        if not self._enter(frame):
            return
        self._mapped = record.session
        if self.saved is None and not record.paused:
            known = self._continued
            update = self.back_end.add(frame if known is None else known.to_map(frame))
            if update is not None:
                place = self.back_end.graph.poses[update.keyframe, :2]
                self._topics.update(frame.stamp, place, update)
                for closure in update.changed:
                    self._logger.warning(describe(closure))
                if update.removed:
                    keys = ', '.join(map(str, update.removed))
                    self._logger.warning(f'no longer seen where they were: reflectors {keys}')
                if update.optimized:
                    self._tell_of_plant()
                    self._topics.correct(self.stamp, self.back_end)
                    self._send_belief(record)
        self._recover(record)
        self._use_last_pose(frame)
        due = self.saved is None and self.products.is_due(frame.stamp)
        if due and self.worker.backlog < MAX_BACKLOG:
            self.publish_map()

    @property
    def _enters(self) -> bool:
        """Whether a saved map is to be gone on with, in which the robot's place is not known."""
        return self.saved is None and self._continued is not None and not self._continued.entered

    @property
    def continued(self) -> dict[str, str]:
        """For /diagnostics: why a saved map is not gone on with yet."""
        known = self._continued
        return {'saved map not entered': known.why} if known is not None and self._enters else {}

    def _enter(self, frame: Frame) -> bool:
        """Whether a frame is in the map to go on with; where not, its place is looked for."""
        if self._continued is None or not self._enters:
            return True
        found = self._continued.enter(frame)
        if found is not None and found.pose is not None and found.cov is not None:
            self._logger.info(f'goes on in the saved map: {found.why}')
            self._topics.start_at(frame.stamp, found.pose, found.cov)
        return not self._enters

    def _begin_session(self) -> None:
        """In the worker: the front end began anew, and so does the map, if it was in it."""
        if self._continued is not None and self._enters:
            self._continued.begin_session()
            return
        if self.saved is None:
            self._keep()
        self._forget()

    def _keep(self) -> None:
        """Write the map in the making under a name of its own, for nothing leads back to it."""
        keys, name = self.back_end.keyframes, self._p.node.map_file_name
        if len(keys) < 2 or keys[-1].stamp == self._written:
            return
        path = self.folder.lost(name, keys[-1].stamp // SECOND)
        try:
            self._write(path, self.products.grid(self.back_end))
        except MapError as e:
            self._logger.warning(f'the map until now is lost: {e}')
            return
        self._logger.warning(f'the map until now is kept: {path}')
        try:
            for old in self.folder.forget_lost(name):
                self._logger.warning(f'an older one is removed: {old}')
        except MapError as e:
            self._logger.warning(f'{e}')

    def _write(self, path: Path, grid: OccupancyGrid | None) -> None:
        map_container.write(path, map_file.content_of(self.back_end, self._p, grid))
        self._written = self.back_end.keyframes[-1].stamp

    def _tell_of_plant(self) -> None:
        """Say so once when the map has entered the frame of the survey."""
        survey_frame = self.back_end.survey_frame
        found = survey_frame is not None and survey_frame.found
        if survey_frame is not None and found and not self._in_plant:
            self._logger.info(f'the map has the frame of the survey: {survey_frame.why}')
        self._in_plant = found

    def _recover(self, record: Record) -> None:
        """Look for a lost robot, and tell the front end what is found.

        While localizing, it begins anew there. A map in the making goes on with the same session:
        nothing that was seen while it was lost is in it.
        """
        frame = record.frame
        if record.paused or record.session == self._told:
            return
        found = self.recovery.look(frame, self.current, self.saved is not None)
        if found is None or found.pose is None or found.cov is None:
            return
        self._logger.info(f'found again: {found.why}')
        if self.saved is not None:
            self._told = record.session  # what is still to come of it is answered
            self._topics.start_at(frame.stamp, found.pose, found.cov)
        else:
            self._topics.relocate(frame.stamp, found.pose, found.cov)

    def _use_last_pose(self, frame: Frame) -> None:
        """Start where the robot was last, if that is verified; and write down where it is."""
        if self._last_pose is None or self.saved is not self._loaded:
            return
        try:
            start = self._last_pose.follow(frame, self._p, self.current(), self._logger)
        except MapError as e:
            self._logger.warning(f'{e}')
            self._last_pose = None  # where it cannot be written now, it cannot later
        else:
            if start is not None:
                self._topics.start_at(frame.stamp, *start)

    def _send_belief(self, record: Record) -> None:
        belief = self.back_end.belief()
        if belief is None:
            return
        if self._continued is not None:
            belief = self._continued.to_session(belief)
        stamped = StampedBelief(
            record.frame.stamp, record.session, self.back_end.T_map_local, belief
        )
        self._topics.believe(stamped)

    def revoke(self, number: str) -> str:
        """In the worker: take a loop closure out of the map for good; what was done.

        Raises MapError or SolverError where that cannot be.
        """
        if not number.isdecimal():
            raise MapError(f'{number!r} is not the number of a loop closure')
        if self.saved is not None:
            raise MapError('the map that is localized in does not change')
        closure = self.back_end.revoke(int(number))
        self._logger.warning(describe(closure))
        self._topics.correct(self.stamp, self.back_end)
        self.publish_map()
        return describe(closure)

    def publish_map(self) -> None:
        """In the worker: send map, trajectory, reflectors and graph now."""
        self.products.publish(self.back_end, self.saved, self.stamp)

    def settle(self) -> None:
        """Send the map of everything so far where no frame has come for a while."""
        silent = time.monotonic() - self._heard >= IDLE
        if silent and self.worker.backlog == 0 and self._is_behind():
            self.worker.submit(lambda: self.publish_map() if self._is_behind() else None)

    def _is_behind(self) -> bool:
        return self.saved is None and self._newest is not None and self.products.stamp < self.stamp

    def send_transform(self) -> None:
        """Publish map to odom at the newest stamp, if it is a new one.

        It waits for no job of the worker, only takes over what the newest one found.
        """
        self.worker.check()
        odom = self._odom.newest
        if odom is None or odom[0] == self._sent or self._enters:
            return
        self._sent, T = odom
        if self._mapped == self._session:  # else the worker is in another local frame
            T = se2.compose(self.back_end.T_map_local, T)
        T = self._steady.follow(self._sent, T, self._odom.T_odom_base)
        n = self._p.node
        self._tf.publish(self._sent, (n.map_frame, n.odom_frame), T)

    def _forget(self) -> None:
        """The local frame is another one; so is the map, but for one that is localized in."""
        if self.saved is None:
            self.back_end.reset()
            self._continued = None
        self.back_end.T_map_local, self.back_end.known = np.zeros(3), None
        self.products.restart()
        self._newest = None
        self._topics.correct(self.stamp, self.back_end)

    def start_at(self, pose: Array) -> None:
        """In the worker: begin anew at a pose of the map, the front end as well."""
        self._forget()
        self._topics.start_at(self.stamp, pose)

    def save(self, name: str) -> str:
        """In the worker: write the map; what was written, in words. Raises MapError."""
        if self.saved is not None and self.saved is self._loaded:
            raise MapError('the map that was loaded does not change: nothing to save')
        current = self.current()
        if current.grid is None and len(current.reflectors) == 0:
            raise MapError(self.products.undrawn or 'there is no map yet')
        why = f', no grid: {self.products.undrawn}' if self.products.undrawn else ''
        if self.back_end.keyframes:
            self._write(self.folder.whole(name), current.grid)
        path = self.folder.save(name, current)
        return f'{path}: {_content(current)}{why}'

    def current(self) -> SavedMap:
        """In the worker: the map as it is now."""
        if self.saved is not None:
            return self.saved
        return SavedMap(self.back_end.reflectors(), self.products.grid(self.back_end))

    def load(self, name: str) -> SavedMap:
        """In the worker: localise in another saved map, or go on mapping with it.

        Raises MapError or FileFormatError; then all is as it was, but for a map in the making
        that turned out not to fit together.
        """
        if self.saved is None:
            self._continue(name)
            return self.current()
        self._load(name)
        if self._last_pose is not None:
            self._last_pose.tried = True  # the robot is where it is, not where it was last
        self._use_saved()
        return self.saved

    def _continue(self, name: str) -> None:
        """Go on with the whole map of a file; what was made until now is forgotten."""
        content = map_file.load(self.folder.whole(name))
        self._keep()
        self._continued = Continued(self._p, content, self.back_end)
        self._written = self.back_end.keyframes[-1].stamp
        self.products.restart()
        self._logger.info(f'{self.folder.whole(name)}: {self._continued.why}')
        self.worker.submit(self.publish_map)

    def _load(self, name: str) -> None:
        self.saved = self._loaded = self.folder.load(name)
        if self._p.node.restore_pose:
            path = self.folder.path(name)
            self._last_pose = LastPose(path.with_name(path.name + '.pose'))

    def _use_saved(self) -> None:
        """Publish the map that never changes, and tell the front end to localize in it."""
        assert self.saved is not None
        self._topics.localize_in(self.stamp, self.saved)
        self.publish_map()

    def localize(self, on: bool) -> str:
        """In the worker: localise in the map as it is now, or begin a new one; what was done.

        Raises MapError where there is no map yet.
        """
        if on == (self.saved is not None):
            return 'localizes already' if on else 'maps already'
        if on:
            current = self.current()
            if current.grid is None and len(current.reflectors) == 0:
                raise MapError('there is no map yet: drive through the place first')
            self.saved = current
            self._use_saved()
            return f'localizes in the map as it is now: {_content(current)}'
        self.saved = None
        self._topics.localize_nowhere(self.stamp)
        self._keep()
        self._forget()
        return 'maps: a new map begins where the robot is, in the axes of the old one'

    def relocalize(self) -> tuple[bool, str]:
        """In the worker: find the newest frame anywhere in the map; whether, and what to do."""
        frame, in_map = self._newest, self.current()
        observation = None if frame is None else frame.observation
        found = localize_globally(in_map.grid, in_map.reflectors, observation, self._p)
        if frame is None or found.verdict is Verdict.IMPOSSIBLE or found.pose is None:
            return False, f'not found: {found.why}; {ADVICE}'
        if found.verdict is Verdict.AMBIGUOUS:
            return False, f'not sure: {found.why}; {ADVICE}'
        x, y, theta = found.pose
        place = f'found at x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°: {found.why}'
        away = se2.between(se2.compose(self.back_end.T_map_local, frame.T_local_base), found.pose)
        distance = math.hypot(away[0], away[1])
        if self.saved is not None:
            assert found.cov is not None
            self._topics.start_at(frame.stamp, found.pose, found.cov)
            return True, f'{place}; {distance:.2f} m from where it was believed'
        if distance < SAME_PLACE and abs(away[2]) < SAME_TURN:
            return True, f'{place}; this is where it is believed to be'
        return False, (
            f'{place}, {distance:.2f} m from where it is believed; a map in the making cannot '
            f'jump: call set_localization_mode first, or reset'
        )


def _content(of: SavedMap) -> str:
    """What is in a map, in words."""
    return f'{len(of.reflectors)} reflectors' + ('' if of.grid is None else ' and a grid')
