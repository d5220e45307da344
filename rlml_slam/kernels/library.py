# SPDX-License-Identifier: Apache-2.0
"""The library of compiled kernels: where it is, and whether it is of these sources.

It lies in the package, where an installation put it and every user reads it, or else in the
user's own cache. Its index names the sources that it was made of; of others it is not used.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import os
import pickle
import platform
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

LIBRARY = '_kernels' + (sysconfig.get_config_var('EXT_SUFFIX') or '.so')
INDEX = '_kernels.index'  # beside it
DECORATOR = 'decorator_of_kernel'  # attribute of a function: which one of jit.py it has there
# What the code of a level may contain, as /proc/cpuinfo names it; best first. Every PC of the last
# ten years has the first, which an image then runs on as well.
LEVELS = {
    'x86-64-v3': {'avx', 'avx2', 'bmi1', 'bmi2', 'f16c', 'fma', 'abm', 'movbe', 'xsave'},
    'x86-64-v2': {'cx16', 'lahf_lm', 'popcnt', 'sse4_1', 'sse4_2', 'ssse3'},
    'x86-64': set(),
}
BY_USER = 'RLML_SLAM_KERNELS'  # jit: compile with Numba though there is a library


@dataclass(frozen=True)
class Index:
    """Of a library: its sources and their digest, its processor, and its entries.

    ``entries``: of each kernel by ``module.name``, (pickled check, name of the entry).
    """

    sources: tuple[str, ...]
    digest: str
    processor: str
    entries: dict[str, list[tuple[bytes, str]]]


@dataclass(frozen=True)
class Library:
    """A loaded library with its index."""

    path: Path
    index: Index
    module: ModuleType


def folders(package: Path) -> tuple[Path, Path]:
    """Where a library may lie: the package itself, then the user's cache."""
    tag = hashlib.sha256(str(package).encode()).hexdigest()[:12]
    return package, cache() / f'kernels-{tag}'


def cache() -> Path:
    """The user's folder for what can be made again."""
    cache = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    return Path(cache) / 'rlml_slam'


def open_library(package: Path) -> Library | None:
    """The library of the package's sources, None where there is none that fits."""
    if os.environ.get(BY_USER) == 'jit':
        return None
    for folder in folders(package):
        index = read_index(folder)
        if index is not None and fits(index, package):
            try:
                return Library(folder / LIBRARY, index, _load(folder / LIBRARY))
            except ImportError:
                continue  # of another C library or Python
    return None


def read_index(folder: Path) -> Index | None:
    """What the library of a folder is made of; None where there is none."""
    try:
        given = pickle.loads((folder / INDEX).read_bytes())
        return Index(**given) if (folder / LIBRARY).exists() else None
    except (OSError, ValueError, TypeError, EOFError, pickle.UnpicklingError):
        return None


def fits(index: Index, package: Path) -> bool:
    """Whether it was made of the sources in ``package``, for a processor like this one."""
    try:
        return runs(index.processor) and digest(package, index.sources) == index.digest
    except OSError:
        return False


def digest(package: Path, sources: tuple[str, ...]) -> str:
    """SHA-256 of files of the package."""
    seen = hashlib.sha256()
    for name in sources:
        text = (package / name).read_bytes()
        seen.update(f'{name} {len(text)}\n'.encode() + text)
    return seen.hexdigest()


def best_processor() -> str:
    """The highest level of code that this machine runs; its own name elsewhere than on PCs."""
    return next((level for level in LEVELS if runs(level)), 'generic')


def runs(processor: str) -> bool:
    """Whether code for ``processor`` runs here."""
    if processor not in LEVELS:
        return platform.machine() not in ('x86_64', 'AMD64')
    levels = list(LEVELS)
    needed = set().union(*(LEVELS[level] for level in levels[levels.index(processor) :]))
    return platform.machine() in ('x86_64', 'AMD64') and needed <= _flags()


def _flags() -> set[str]:
    """Of the first processor; none where the system does not say."""
    try:
        with open('/proc/cpuinfo', encoding='ascii', errors='replace') as lines:
            found = next((line for line in lines if line.startswith('flags')), ':')
    except OSError:
        return set()
    return set(found.partition(':')[2].split())


def _load(path: Path) -> ModuleType:
    """The module; it does not depend on where the file lies."""
    name = 'rlml_slam._kernels'
    loader = importlib.machinery.ExtensionFileLoader(name, str(path))
    spec: Any = importlib.util.spec_from_file_location(name, path, loader=loader)
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    sys.modules[name] = module
    return module
