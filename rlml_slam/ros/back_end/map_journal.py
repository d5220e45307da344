# SPDX-License-Identifier: Apache-2.0
"""Journals of maps in the making: written beside the saved maps, used after a crash.

``NAME.journal-SECONDS`` is locked by the process that writes it, and removed where the map was
saved. One that nobody locks belonged to a process that was killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import time
from pathlib import Path
from typing import IO, Any

from rlml_slam.errors import MapError, RlmlError
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_archive import WORTH_KEEPING
from rlml_slam.ros.back_end.map_folder import AUTOSAVE, MapFolder
from rlml_slam.slam.store import journal, map_file
from rlml_slam.slam.store.journal import Journal

JOURNAL = '.journal-'  # in the names of the files
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
        self.problem = ''
        self._start(None)

    def _start(self, base: Content | None) -> None:
        self._journal = Journal(self._p, base)
        self._keyframes = 0 if base is None else WORTH_KEEPING
        self._due = time.monotonic()

    def restart(self, base: Content | None = None, keep: bool = False) -> None:
        """Another map begins, or ``base`` is continued. ``keep`` the file of the map until now."""
        self.close(keep)
        self._start(base)

    def add(self, frame: Any, is_keyframe: bool) -> None:
        """A frame that the graph was given."""
        if self._p.node.journal_period == 0.0 or self.problem:
            return
        self._keyframes += is_keyframe
        self._journal.add(frame, is_keyframe)
        self.write()

    @property
    def is_due(self) -> bool:
        """Whether there is something to be written by now."""
        late = time.monotonic() - self._due >= self._p.node.journal_period
        return late and self._keyframes >= WORTH_KEEPING and not self.problem

    def write(self) -> None:
        """Write what has come, if it is due."""
        if not self.is_due or self._p.node.journal_period == 0.0:
            return
        try:
            if self._file is None:
                self._file = self._open()
            self._journal.write(self._file)
            if self._file.tell() > MAX_BYTES:
                self._stop(f'has {MAX_BYTES / 1e9:.0f} GB: save the map and start again')
        except OSError as e:
            self._stop(f'cannot be written: {e.strerror or e}')
        self._due = time.monotonic()

    def _open(self) -> IO[bytes]:
        """A new file, locked for as long as this process lives."""
        path = self._folder.path(self._p.node.map_file_name)
        path.parent.mkdir(parents=True, exist_ok=True)
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

    def recover(self) -> None:
        """Make maps of what killed processes left."""
        for path in self._left():
            with path.open('rb') as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    continue  # another process is writing it
                self._recover(path)

    def _left(self) -> list[Path]:
        path = self._folder.path(self._p.node.map_file_name)
        return sorted(path.parent.glob(f'{path.name}{JOURNAL}*[0-9]'))

    def _recover(self, path: Path) -> None:
        name = self._p.node.map_file_name
        self._logger.warning(
            f'{path}: the last run ended without saving its map; recovering it '
            f'({path.stat().st_size / 1e6:.1f} MB)'
        )
        try:
            back_end, params = journal.recover(path, self._folder.survey(self._p.back_end.survey))
            if not back_end.keyframes:
                raise MapError('it has no frames')
            content = map_file.content_of(back_end, params, back_end.occupancy_grid())
            to = self._folder.free(name, AUTOSAVE, int(time.time()))
            map_container.write(to, content)
        except (RlmlError, OSError, KeyError, ValueError) as e:
            bad = path.with_name(path.name + '.damaged')
            path.rename(bad)
            self._logger.error(f'{bad}: no map can be made of it: {e}')
            return
        path.unlink()
        self._logger.warning(f'recovered: {len(back_end.keyframes)} keyframes in {to}')
