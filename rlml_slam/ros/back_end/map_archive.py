# SPDX-License-Identifier: Apache-2.0
"""Maps between a running back end and the folder of saved maps."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from rlml_slam.errors import MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap, newer_image
from rlml_slam.motion import SECOND
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_folder import AUTOMATIC, AUTOSAVE, LOST, SUFFIXES, MapFolder
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.store import map_file

WORTH_KEEPING = 10  # keyframes that are in no file


class MapArchive:
    """Writes maps for users, and those that would be lost otherwise; loads and checks them."""

    def __init__(self, params: Parameters, logger: Any) -> None:
        self._p = params
        self._logger = logger
        self.folder = MapFolder(params.node.map_directory)
        self.unsaved = 0  # keyframes added since the map in the making was written

    def load(self, name: str) -> Content:
        """A whole map of the folder. Raises MapError or FileFormatError."""
        whole = self.folder.readable(self.folder.whole(name))
        if name.endswith(SUFFIXES) and not name.endswith(whole.suffix):
            raise MapError(f'{name} can be localized in; only a .rlml file can be continued')
        content = map_file.load(whole)
        self.folder.loaded.add(whole)
        self._compare_image(whole)
        return content

    def load_saved(self, name: str) -> SavedMap:
        """A map of the folder to localize in. Raises MapError or FileFormatError."""
        saved = self.folder.load(name)
        if not name.endswith(SUFFIXES) or name.endswith('.rlml'):
            self._compare_image(self.folder.whole(name))
        return saved

    def _compare_image(self, whole: Path) -> None:
        if note := newer_image(whole):
            self._logger.warning(note)

    def save(self, name: str, back_end: BackEnd, current: SavedMap, undrawn: str) -> str:
        """Write a map under a name; what was written. Raises MapError."""
        whole = self.folder.whole(name)
        if any(kind in whole.name for kind in AUTOMATIC):
            raise MapError(f'{name!r} is a name of automatic files, which are removed in time')
        if current.grid is None and len(current.reflectors) == 0:
            raise MapError(undrawn or 'there is no map yet')
        try:
            path = self.folder.save(name, current)
        finally:  # after its image, which would be newer otherwise
            if back_end.keyframes:
                self._write(whole, back_end, current.grid)
        return f'{path}: {contents(current)}{f", no grid: {undrawn}" if undrawn else ""}'

    def keep(self, back_end: BackEnd, grid: OccupancyGrid | None, reason: str) -> bool:
        """Write a map that is about to be replaced to a file of its own, if it is worth it.

        Whether nothing is lost thereby.
        """
        if self.unsaved < WORTH_KEEPING:
            return True
        stamp = back_end.keyframes[-1].stamp
        return self._keep(LOST, stamp // SECOND, back_end, grid, reason)

    def autosave(self, back_end: BackEnd, grid: OccupancyGrid | None) -> bool:
        """The same at the end of the process, where anything is in no file yet."""
        keys = max(len(back_end.keyframes), self.unsaved)
        if keys < WORTH_KEEPING or self.unsaved == 0:
            return True
        return self._keep(AUTOSAVE, int(time.time()), back_end, grid, 'the node ends')

    def _keep(
        self, kind: str, seconds: int, back_end: BackEnd, grid: OccupancyGrid | None, reason: str
    ) -> bool:
        name = self._p.node.map_file_name
        try:
            for old in self.folder.make_room(name, time.time()):
                self._logger.warning(f'{reason}: an old map is removed: {old}')
            path = self.folder.free(name, kind, seconds)
            self._write(path, back_end, grid)
        except MapError as e:
            self._logger.warning(f'{reason}: the map until now is not kept: {e}')
            return False
        self._logger.warning(f'{reason}: the map until now is kept: {path}')
        return True

    def begin(self) -> None:
        """The map in the making is another one, all of which is in a file."""
        self.unsaved = 0

    def _write(self, path: Path, back_end: BackEnd, grid: OccupancyGrid | None) -> None:
        map_container.write(path, map_file.content_of(back_end, self._p, grid))
        self.unsaved = 0


def contents(of: SavedMap) -> str:
    """What is in a map, in words."""
    return f'{len(of.reflectors)} reflectors' + ('' if of.grid is None else ' and a grid')
