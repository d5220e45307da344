# SPDX-License-Identifier: Apache-2.0
"""Saved maps: files of one folder, never outside of it."""

from __future__ import annotations

from pathlib import Path

from rlml_slam.errors import MapError, NoMapError
from rlml_slam.maps import nav2_map, reflector_file, saved_map, survey
from rlml_slam.maps.atomic_file import PREVIOUS, set_aside
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.maps.survey import Survey
from rlml_slam.slam.store import map_file

# in the names of maps that were written without a user's request: one that another took the place
# of, and one that was in the making when its process ended
# and the journal of one
LOST, AUTOSAVE, JOURNAL = AUTOMATIC = ('.lost-', '.autosave-', '.journal-')
ENDS = ('.rlml', f'.rlml{PREVIOUS}')
MAX_NAME = 200  # bytes
LOST_AGE = 30 * 86400.0  # [s] after which such a file is removed
LOST_BYTES = 1_000_000_000  # of such files: where there are more, no other one is written
IMAGES = ('.pgm', '.png', '.bmp')
SUFFIXES = ('.rlml', '.yaml', '.csv', *IMAGES)


class MapFolder:
    """The folder of the parameter ``map_directory``."""

    def __init__(self, directory: str) -> None:
        self.root = Path(directory).expanduser().resolve()
        self.loaded: set[Path] = set()  # what this process goes on with is never removed

    def path(self, name: str) -> Path:
        """The path of a map without its suffixes; MapError if it lies outside of the folder."""
        name = name.removeprefix('file://')
        for suffix in SUFFIXES:
            name = name.removesuffix(suffix)
        path = self._inside(name, 'map')
        if not name or path == self.root:
            raise MapError(f'map {name!r} is not inside of map_directory, {self.root}')
        return path

    def _inside(self, name: str, what: str) -> Path:
        """A path of the folder, links followed; MapError where it leads out, or is none."""
        if any(ord(c) < ord(' ') for c in name) or len(name.encode(errors='replace')) > MAX_NAME:
            raise MapError(f'{what} {name[:MAX_NAME]!r} is no name of a file')
        path = (self.root / name).resolve()
        if not path.is_relative_to(self.root):
            raise MapError(f'{what} {name!r} is not inside of map_directory, {self.root}')
        return path

    def readable(self, path: Path) -> Path:
        """The path of a file; MapError where it is a link out of the folder, or no plain file."""
        inside = path.resolve().is_relative_to(self.root)
        if path.exists() and not (path.is_file() and inside):
            raise MapError(f'{path} is no file inside of map_directory, {self.root}')
        return path

    def survey(self, name: str) -> Survey | None:
        """Surveyed reflectors; None without a name. MapError or FileFormatError if unusable."""
        if not name:
            return None
        return survey.load(self.readable(self._inside(name, 'survey')))

    def save(self, name: str, saved: SavedMap) -> Path:
        """Write name.csv, and name.pgm with name.yaml where there is a grid.

        Without one, those of an older map of the name are set aside: they would be read with this.
        """
        path = self.path(name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise MapError(f'{path.parent}: cannot be made: {e.strerror}') from e
        reflector_file.save(saved.reflectors, path.with_name(path.name + '.csv'))
        if saved.grid is not None:
            nav2_map.save(saved.grid, path)
            return path
        set_aside(*(path.with_name(path.name + suffix) for suffix in ('.yaml', '.pgm')))
        return path

    def whole(self, name: str) -> Path:
        """The path of the one file that has everything of a map."""
        path = self.path(name)
        return path.with_name(path.name + '.rlml')

    def free(self, name: str, kind: str, seconds: int) -> Path:
        """The path for an automatic map of a kind, made until a time [s]; no file has it yet."""
        begin = f'{self.path(name).relative_to(self.root)}{kind}{seconds}'
        path, k = self.whole(begin), 1
        while path.exists():
            k += 1
            path = self.whole(f'{begin}-{k}')
        return path

    def newest(self, name: str) -> Path:
        """The path of a whole map, or of a younger one of it that was saved automatically."""
        whole = self.whole(name)
        saved = [f for f in self.automatic(name, (AUTOSAVE,)) if f.name.endswith('.rlml')]
        files = [*saved, *([whole] if whole.exists() else [])]
        return max(files, key=lambda file: file.stat().st_mtime_ns, default=whole)

    def make_room(self, name: str, now: float) -> list[Path]:
        """Remove automatic maps that are older than LOST_AGE at a time [s]; which.

        No other file is ever removed: no journal, nor what a start would continue or was loaded.
        Raises MapError where automatic files fill LOST_BYTES.
        """
        path = self.path(name)
        try:
            kept = {*self.loaded, self.newest(name)}
            maps = [f for f in self.automatic(name, (LOST, AUTOSAVE)) if f not in kept]
            old = [f for f in maps if now - f.stat().st_mtime > LOST_AGE]
            for file in old:
                file.unlink(missing_ok=True)
                file.with_name(file.name + PREVIOUS).unlink(missing_ok=True)
            size = sum(file.stat().st_size for file in self.automatic(name))
        except OSError as e:
            raise MapError(f'{path}: {e.filename}: {e.strerror}') from e
        if size > LOST_BYTES:
            raise MapError(
                f'{path}: {", ".join(AUTOMATIC)}… have {size / 1e6:.0f} MB; remove those that are '
                f'not needed, so that others can be kept'
            )
        return old

    def automatic(self, name: str, kinds: tuple[str, ...] = AUTOMATIC) -> list[Path]:
        """Files of a map that were written without a user's request, by name."""
        path = self.path(name)
        begin = tuple(path.name + kind for kind in kinds)
        if not path.parent.is_dir():
            return []
        journal = path.name + JOURNAL
        return sorted(
            file for file in path.parent.iterdir()
            if file.name.startswith(begin)
            and (file.name.endswith(ENDS) or file.name.startswith(journal))
        )  # fmt: skip

    def load(self, name: str) -> SavedMap:
        """Read name.rlml where it is there, else name.csv and name.yaml; a suffix says which.

        NoMapError names the files that are not there; MapError or FileFormatError says what is
        wrong with which file.
        """
        path = self.path(name)
        files = [path.with_name(path.name + suffix) for suffix in ('.rlml', '.csv', '.yaml')]
        if name.endswith(IMAGES):
            files = files[2:]
        elif name.endswith(SUFFIXES):
            files = [file for file in files if name.endswith(file.suffix)]
        found = next((file for file in files if self.readable(file).exists()), None)
        if found is None:
            names = ' and no '.join(f.name for f in files)
            raise NoMapError(f'{path.parent}: there is no {names}')
        self.loaded.add(found)
        if found.suffix == '.rlml':
            return map_file.saved_map(map_file.load(found))
        self.readable(found.with_suffix('.csv'))
        meta = self.readable(found.with_suffix('.yaml'))
        if meta.exists():
            self.readable(nav2_map.describe(meta).image)
        return saved_map.load(found)
