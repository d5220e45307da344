# SPDX-License-Identifier: Apache-2.0
"""Journals of maps in the making: written beside the saved maps, used after a crash.

``NAME.journal-SECONDS`` is locked by the process that writes it, and removed where the map was
saved. One that nobody locks belonged to a process that was killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import time
from pathlib import Path
from typing import IO, Any

from rlml_slam.errors import MapError, RlmlError
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_archive import WORTH_KEEPING
from rlml_slam.ros.back_end.map_folder import AUTOSAVE, JOURNAL, LOST, MapFolder
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.slam.store import journal, map_file
from rlml_slam.slam.store.journal import Journal

MAX_BYTES = 2_000_000_000  # of one journal


class MapJournal:
    """Takes the frames of the map in the making; what goes wrong is in ``problem``, and logged.

    Its methods are called in one thread.
    """

    def __init__(self, folder: MapFolder, params: Parameters, logger: Any) -> None:
        self._folder = folder
        self._p = params
        self._logger = logger
        self._file: IO[bytes] | None = None
        self.ends = False  # whether a recovery is to stop, and be left to the next start
        self._start(None)

    def _start(self, base: Content | None) -> None:
        self._journal = Journal(self._p, base)
        self._has_keyframes = base is not None
        self._due = time.monotonic()
        self.problem = ''

    def restart(self, base: Content | None = None, keep: bool = False) -> None:
        """Another map begins, or ``base`` is continued. ``keep`` the file of the map until now."""
        self.close(keep)
        self._start(base)

    def add(self, frame: Any, is_keyframe: bool, found: FoundPose | None) -> None:
        """A frame that the graph was given, and where a search has found the robot."""
        if self._p.node.journal_period == 0.0 or self.problem:
            return
        self._has_keyframes |= is_keyframe
        self._journal.add(frame, is_keyframe, found)
        self.write()

    def revoke(self, number: int) -> None:
        """A loop closure that the graph is to have no more; on disk at once."""
        if self._p.node.journal_period > 0.0 and not self.problem:
            self._journal.revoke(number)
            self.flush()

    @property
    def is_due(self) -> bool:
        """Whether there is something to be written by now."""
        late = time.monotonic() - self._due >= self._p.node.journal_period
        return late and self._has_keyframes and not self.problem

    def write(self) -> None:
        """Write what has come, if it is due."""
        if not self.is_due or self._p.node.journal_period == 0.0:
            return
        try:
            if self._file is None:
                self._file = self._open()
            self._journal.write(self._file)
            if os.fstat(self._file.fileno()).st_nlink == 0:
                self._stop('was removed: save the map')
            if self._file.tell() > MAX_BYTES:
                self._stop(f'has {MAX_BYTES / 1e9:.0f} GB: save the map and start again')
        except OSError as e:
            self._stop(f'cannot be written: {e.strerror or e}')
        except MapError as e:
            self._stop(f'cannot be written: {e}')
        self._due = time.monotonic()

    def flush(self) -> None:
        """Write what has come, due or not."""
        self._due = -math.inf
        self.write()

    def _open(self) -> IO[bytes]:
        """A new file, locked for as long as this process lives."""
        path = self._folder.path(self._p.node.map_file_name)
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in self._folder.make_room(self._p.node.map_file_name, time.time()):
            self._logger.warning(f'an old map is removed: {old}')
        name, k = f'{path.name}{JOURNAL}{int(time.time())}', 1
        while path.with_name(f'{name}-{k}').exists():
            k += 1
        file = path.with_name(f'{name}-{k}').open('xb')
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return file

    def _stop(self, why: str) -> None:
        path = self._folder.path(self._p.node.map_file_name)
        self.problem = f'{path}{JOURNAL}… {why}'
        self._logger.warning(f'{self.problem}; if the process is killed now, this map is lost')

    def close(self, keep: bool) -> None:
        """End the file; it is removed unless its map is nowhere else."""
        if self._file is None:
            return
        if not keep:
            with contextlib.suppress(OSError):
                Path(self._file.name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._file.close()
        self._file = None

    def recover(self) -> Path | None:
        """Make maps of what killed processes left; the path of the last one worth continuing."""
        made = None
        for path in self._left():
            try:
                with path.open('rb') as file:
                    if os.fstat(file.fileno()).st_size == 0:
                        continue  # opened this moment, and not locked yet
                    try:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except OSError:
                        continue  # another process is writing it
                    made = self._recover(path) or made
            except OSError as e:
                self._logger.error(f'{path}: not recovered: {e.strerror or e}')
        return made

    def _check(self) -> None:
        if self.ends:
            raise InterruptedError

    def _left(self) -> list[Path]:
        files = self._folder.automatic(self._p.node.map_file_name, (JOURNAL,))
        return [path for path in files if path.name[-1].isdecimal() and path.is_file()]

    def _recover(self, path: Path) -> Path | None:
        self._logger.warning(
            f'{path}: the last run ended without saving its map; recovering it '
            f'({path.stat().st_size / 1e6:.1f} MB)'
        )
        try:
            survey = self._folder.survey(self._p.back_end.survey)
            back_end, params = journal.recover(path, survey, self._check)
            content = map_file.content_of(back_end, params, back_end.occupancy_grid())
        except InterruptedError:
            self._logger.warning(f'{path}: left for the next start')
            return None
        except (RlmlError, OSError) as e:
            bad = path.with_name(path.name + '.damaged')
            path.rename(bad)
            self._logger.error(f'{bad}: no map can be made of it: {e}')
            return None
        return self._save(path, content, len(back_end.keyframes))

    def _save(self, path: Path, content: Content, keys: int) -> Path | None:
        """Write a recovered map; its path, unless it is too small to displace the map there."""
        name = self._p.node.map_file_name
        try:
            there = self._folder.newest(name)
            wins = keys >= WORTH_KEEPING or not there.exists() or journal.has_base(path)
            to = self._folder.free(name, AUTOSAVE if wins else LOST, int(time.time()))
            map_container.write(to, content)
            path.unlink()
        except (MapError, OSError) as e:
            self._logger.error(f'{path}: left for the next start: {e}')
            return None
        why = '' if wins else f'; too few: {there} remains the newest map'
        self._logger.warning(f'recovered: {keys} keyframes in {to}{why}')
        return to if wins else None
