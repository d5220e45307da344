# SPDX-License-Identifier: Apache-2.0
"""What users ask of a running back end. A request that fails leaves everything as it was."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import numpy as np

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.saved_map import SavedMap, require_contents
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.last_pose import LastPose
from rlml_slam.ros.back_end.map_archive import WORTH_KEEPING, contents
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.slam.closures.closure_table import describe
from rlml_slam.slam.conversation import Answer, Command
from rlml_slam.slam.store import map_file

PAUSED = 'new measurements are left out, see pause_new_measurements'


class UserRequests:
    """Methods are called in the mapper's worker; files are read and checked before they act.

    At once, it reads what the parameters ask for at the start: then it raises MapError or
    FileFormatError where a map cannot be used. ``begin`` acts.
    """

    def __init__(self, mapper: Mapper, params: Parameters, logger: Any) -> None:
        self._mapper = mapper
        self._archive = mapper.archive
        self._p = params
        self._logger = logger
        self._is_loaded = False  # whether the map that is localized in came from the folder
        self._first = self._begin()

    def begin(self) -> None:
        """Do what the parameters ask for; later, send the map as it is now."""
        self._mapper.worker.submit(self._on_begin)

    def _on_begin(self) -> None:
        mapper = self._mapper
        if not self._do_first() and (mapper.stamp > 1 or mapper.system.map is not None):
            mapper.publish_map()

    def _do_first(self) -> bool:
        """What the parameters ask for comes before requests; whether it was still to be done."""
        first, self._first = self._first, []
        self._mapper.execute(first)
        return bool(first)

    def _begin(self) -> list[Command]:
        node, system = self._p.node, self._mapper.system
        name = node.map_file_name
        if node.mode == 'localization':
            return self._localize_in(name, is_first=True)
        begin, journal = system.make_map(), self._mapper.journal
        if not node.continue_map:
            self._mapper.searcher.worker.submit(journal.recover)
            return begin
        # times of files are no evidence: a robot's clock may have been set back since
        whole = journal.recover() or self._archive.folder.newest(name)
        if whole.exists():
            self._logger.info(f'continues {whole}')
            return [*begin, *self._continue(str(whole.relative_to(self._archive.folder.root)))]
        self._logger.warning(f'{whole} does not exist: another map begins')
        return begin

    def reset(self) -> str:
        """Begin at ``map_start_pose``; what was done."""
        self._do_first()
        system = self._mapper.system
        localizes = system.map is not None
        self._mapper.execute(system.reset(np.array(self._p.node.map_start_pose)))
        if localizes:
            return 'begins at map_start_pose in the same map'
        return 'another map begins at map_start_pose'

    def save(self, name: str) -> str:
        """Write the map; what was written. Raises MapError."""
        mapper = self._mapper
        if mapper.system.map is not None and self._is_loaded:
            raise MapError('the map that was loaded does not change: nothing to save')
        current = mapper.current()
        undrawn = mapper.products.undrawn if mapper.system.map is None else ''
        if mapper.system.frames.is_paused and not mapper.back_end.keyframes:
            undrawn = undrawn or f'there is no map yet: {PAUSED}'
        text = self._archive.save(name, mapper.back_end, current, undrawn)
        if mapper.journal.problem and mapper.back_end.keyframes:  # what has come since is in it
            content = map_file.content_of(mapper.back_end, self._p, current.grid)
            mapper.journal.restart(content)
        return text

    def load(self, name: str) -> SavedMap:
        """Localize in another saved map, or while mapping go on with it.

        Raises MapError or FileFormatError.
        """
        self._do_first()
        mapper = self._mapper
        if mapper.system.map is not None:
            mapper.execute(self._localize_in(name))
        else:
            mapper.execute(self._continue(name))
        return mapper.current()

    def _localize_in(self, name: str, is_first: bool = False) -> list[Command]:
        """Localize in a saved map; at first from the pose of the last run, if that fits."""
        folder = self._archive.folder
        saved, last, pose = self._archive.load_saved(name), None, None
        if self._p.node.restore_pose:
            path = folder.path(name)
            last = LastPose(path.with_name(f'{path.name}{self._mapper.robot}.pose'))
            try:
                pose = last.read() if is_first else None
            except FileFormatError as e:
                self._logger.warning(f'{e}')
        self._is_loaded, self._mapper.last_pose = True, last
        return self._mapper.system.localize_in(saved, pose, last is not None)

    def _continue(self, name: str) -> list[Command]:
        content, loaded = self._archive.load(name), self._mapper.new_back_end()
        map_file.restore(content, loaded)
        saved = map_file.saved_map(content)
        self._mapper.loaded = loaded, content
        return self._mapper.system.continue_map(saved, loaded.reflector_graph.next_key)

    def localize(self, on: bool) -> str:
        """Localize in the map as it is now, or begin a new one; what was done.

        Raises MapError where there is no map yet.
        """
        self._do_first()
        mapper, system = self._mapper, self._mapper.system
        if on == (system.map is not None):
            return 'localizes already' if on else 'maps already'
        if not on:
            mapper.execute(system.make_map())
            paused = f'; {PAUSED}' if system.frames.is_paused else ''
            return f'maps: a new map begins where the robot is, in the axes of the old one{paused}'
        if system.entry is not None and not system.entry.is_saved:
            raise MapError(system.entry.problem)
        current = require_contents(mapper.current())
        self._is_loaded, mapper.last_pose = False, None
        mapper.execute(system.localize_in(current))
        return f'localizes in the map as it is now: {contents(current)}'

    def relocalize(self) -> Future[Answer]:
        """Find the newest frame anywhere in the map; the answer comes later."""
        number, commands = self._mapper.system.relocalize()
        answer = self._mapper.answers[number] = Future()
        self._mapper.execute(commands)
        return answer

    def revoke(self, number: str) -> str:
        """Take a loop closure out of the map for good; what was done.

        Raises MapError or SolverError where that cannot be.
        """
        mapper, back_end = self._mapper, self._mapper.back_end
        if not number.isdecimal():
            raise MapError(f'{number!r} is not the number of a loop closure')
        if mapper.system.map is not None:
            raise MapError('the map that is localized in does not change')
        closure = back_end.revoke(int(number))
        self._archive.unsaved += WORTH_KEEPING  # a user's decision is worth as much
        mapper.journal.revoke(int(number))
        self._logger.warning(describe(closure))
        known, stamp = back_end.known, back_end.keyframes[-1].stamp
        cov = None if known is None else known.cov_map
        mapper.execute(mapper.system.on_solved(stamp, back_end.T_map_local, cov))
        mapper.publish_map()
        return describe(closure)
