# SPDX-License-Identifier: Apache-2.0
"""Where the bags of a fleet are: this machine, or any store that fsspec knows."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from rlml_lab.fleet.store_errors import naming
from rlml_slam.errors import BagError

METADATA = 'metadata.yaml'
FILES = ('.bag', '.mcap')  # bags of one file


@dataclass(frozen=True)
class Bag:
    """A bag of a fleet: its name, which is its folder in the results, and its fsspec URL."""

    name: str
    url: str

    @property
    def relations_url(self) -> str:
        """Where its relations are, if it has some."""
        return f'{self.url}.relations'


def find_bags(urls: Sequence[str]) -> list[Bag]:
    """All bags in or below folders, files and globs, by name.

    A bag is named by its path below the folder that was given, or below the fixed part of the
    glob. Raises BagError where a place has none, or two bags have one name.
    """
    found: dict[str, Bag] = {}
    for url in urls:
        below = _bags_below(url)
        if not below:
            raise BagError(f'{url}: no bag there')
        for bag in below:
            if found.setdefault(bag.name, bag) != bag:
                raise BagError(
                    f'{found[bag.name].url} and {bag.url} would both be named {bag.name}; '
                    'give the folder above them'
                )
    return [found[name] for name in sorted(found)]


def _bags_below(url: str) -> list[Bag]:
    """The bags of one place."""
    with naming(url, 'cannot be read', BagError):
        fs, path = url_to_fs(url)
        path = path.rstrip('/')
        fixed = re.split(r'[*?[]', path, maxsplit=1)[0]
        places = [path] if fixed == path else [p.rstrip('/') for p in fs.glob(path)]
        found = {bag for place in places for bag in _bags_in(fs, place)}
    root = posixpath.dirname(fixed) if fixed != path or path in found else path
    return [Bag(posixpath.relpath(p, root), _url(fs, p)) for p in found]


def _url(fs: Any, path: str) -> str:
    """A path with its protocol; without one where it is on this machine."""
    return path if 'file' in _protocols(fs) else str(fs.unstrip_protocol(path))


def _protocols(fs: Any) -> tuple[str, ...]:
    return (fs.protocol,) if isinstance(fs.protocol, str) else tuple(fs.protocol)


def _bags_in(fs: Any, place: str) -> set[str]:
    """Folders with rosbag2 files, and bags of one file that are in none of them."""
    files = [place] if fs.isfile(place) else _files_below(fs, place)
    folders = {
        posixpath.dirname(f)
        for f in files
        if posixpath.basename(f) == METADATA or f.endswith('.db3')
    }
    alone = {f for f in files if f.endswith(FILES) and posixpath.dirname(f) not in folders}
    return alone | {f for f in folders if fs.isdir(place)}


def _files_below(fs: Any, place: str) -> list[str]:
    """All files of a folder; on this machine also those of folders that are links."""
    if 'file' not in _protocols(fs):
        return list(fs.find(place))
    found, known = list[str](), set[str]()
    for folder, folders, files in os.walk(place, followlinks=True):
        real = os.path.realpath(folder)
        if real in known:  # a link to a folder that it is in, or a second one to the same
            folders.clear()
            continue
        known.add(real)
        folders.sort()
        found += [posixpath.join(folder, f) for f in files]
    return found


def local_copy(url: str, into: Path) -> Path:
    """The path of a bag on this machine: where it is, or a copy below ``into``."""
    fs, path = url_to_fs(url)
    if 'file' in _protocols(fs):
        return Path(path)
    target = into / posixpath.basename(path)
    if fs.isfile(path):
        fs.get_file(path, str(target))
        return target
    for file in fs.find(path):
        here = target / posixpath.relpath(file, path)
        here.parent.mkdir(parents=True, exist_ok=True)
        fs.get_file(file, str(here))
    return target


def in_words(n: int) -> str:
    """A number of bags for people."""
    return '1 bag' if n == 1 else f'{n} bags'
