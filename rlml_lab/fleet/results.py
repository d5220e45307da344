# SPDX-License-Identifier: Apache-2.0
"""The results of a fleet: a folder per bag, here or in any store that fsspec knows."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from rlml_lab.fleet.store_errors import naming
from rlml_slam.maps.atomic_file import write_atomically

RECORD, ALL, TRIAL = 'run.json', 'fleet.json', 'fleet.trial'


@dataclass(frozen=True)
class Record:
    """What is known of one run.

    ``key`` names bag, parameters and code, empty where the bag could not be read. ``row`` has the
    figures, which depend on the key alone; ``times`` what it cost; ``files`` are those of its
    folder.
    """

    key: str
    row: dict[str, Any]
    times: dict[str, Any] = field(default_factory=dict)
    files: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The bag's name."""
        return str(self.row['name'])


class Results:
    """Folders of results below a URL. The record of a run is written last: it vouches for it."""

    def __init__(self, url: str) -> None:
        with naming(url, 'cannot be used'):
            self._fs, self._root = url_to_fs(url)
        protocol = self._fs.protocol
        self._is_local = 'file' in ((protocol,) if isinstance(protocol, str) else protocol)

    @property
    def url(self) -> str:
        """The whole URL, the same from every folder; a path where it is on this machine."""
        return self._root if self._is_local else str(self._fs.unstrip_protocol(self._root))

    def path(self, *parts: str) -> str:
        """A path in the store."""
        return '/'.join([self._root.rstrip('/'), *parts])

    def try_to_write(self) -> None:
        """Before hours of work: raises MapError if nothing can be written there."""
        self.write(b'', TRIAL)
        # some may write there, but delete nothing; or another run has removed it
        with contextlib.suppress(Exception):
            self._fs.rm_file(self.path(TRIAL))

    def write(self, data: bytes, *parts: str) -> None:
        """One file, whole or not at all. Raises MapError if it cannot be written."""
        path = self.path(*parts)
        with naming(path, 'cannot be written'):
            if self._is_local:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(Path(path), data)
            else:
                self._fs.pipe_file(path, data)

    def find(self, name: str, key: str = '') -> Record | None:
        """The record of a bag, with that key if one is given; None where there is no whole one."""
        try:
            with naming(self.url, 'cannot be read'):
                data = self._data(name, RECORD)
            if data is None:
                return None
            c = json.loads(data)
            record = Record(c['key'], c['row'], c['times'], tuple(c['files']))
        except (ValueError, KeyError, TypeError):
            return None  # not ours, or of another version
        return record if key in ('', record.key) else None

    def _data(self, *parts: str) -> bytes | None:
        """A file, None where there is none."""
        try:
            data: bytes = self._fs.cat_file(self.path(*parts))
        except FileNotFoundError:
            return None
        return data

    def keep(self, folder: Path, record: Record) -> None:
        """Take the files of a finished run in place of older ones.

        Raises MapError if they cannot be written.
        """
        place = self.path(record.name)
        with naming(place, 'cannot be written'):
            if self._fs.exists(self.path(record.name, RECORD)):
                self._fs.rm_file(self.path(record.name, RECORD))
            if self._fs.isdir(place):
                for old in self._fs.ls(place, detail=False):
                    if self._fs.isfile(old):
                        self._fs.rm_file(old)
            self._fs.makedirs(place, exist_ok=True)
            for file in sorted(folder.iterdir()):
                self._fs.put_file(str(file), self.path(record.name, file.name))
        self.write((json.dumps(asdict(record), indent=1) + '\n').encode(), record.name, RECORD)

    def write_all(self, records: Sequence[Record]) -> None:
        """All records as one file, which makes these results a baseline."""
        rows = [{'key': r.key, 'row': r.row} for r in records]
        self.write((json.dumps(rows, indent=1) + '\n').encode(), ALL)

    def read_all(self) -> list[Record]:
        """The records of a whole run of a fleet. Raises MapError where there is none."""
        with naming(self.path(ALL), 'not the results of a whole fleet'):
            content = json.loads(self._fs.cat_file(self.path(ALL)))
            return [Record(c['key'], c['row']) for c in content]
