# SPDX-License-Identifier: Apache-2.0
"""Libraries that this user has built, so that nothing is compiled twice from the same sources.

A new clone, a wheel and a workspace take one of the same sources, Python, Numba, NumPy and
processor level; the last ones used are kept in the user's cache.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import os
import shutil
import tempfile
from pathlib import Path

from rlml_slam.kernels import library

KEPT = 3  # libraries, of 2.5 MB each
MAKERS = ('build.py', 'emit.py', 'table.c')  # beside the sources, they decide what is in it
COMPILERS = ('numba', 'llvmlite', 'numpy', 'scipy')


def place_of(package: Path, index: library.Index) -> Path | None:
    """Folder of the library that ``index`` describes; None where its compiler is not known."""
    try:
        versions = [importlib.metadata.version(name) for name in COMPILERS]
        makers = library.digest(package / 'kernels', MAKERS)
    except (OSError, importlib.metadata.PackageNotFoundError):
        return None
    made_of = (index.sources, index.digest, index.processor, library.LIBRARY, versions, makers)
    return library.cache() / 'built' / hashlib.sha256(repr(made_of).encode()).hexdigest()[:16]


def take(place: Path, folder: Path) -> bool:
    """Copy the library of a place into ``folder``; False where there is none."""
    if library.read_index(place) is None:
        return False
    try:
        _copy(place, folder)
    except OSError:
        return False
    with contextlib.suppress(OSError):
        os.utime(place)
    return True


def keep(folder: Path, place: Path) -> None:
    """Copy the library of ``folder`` to its place, and drop those not used for longest.

    A cache that cannot be written to keeps nothing.
    """
    with contextlib.suppress(OSError):
        place.mkdir(parents=True, exist_ok=True)
        _copy(folder, place)
        os.utime(place)
        kept = sorted(place.parent.iterdir(), key=lambda one: one.stat().st_mtime, reverse=True)
        for old in kept[KEPT:]:
            shutil.rmtree(old, ignore_errors=True)


def _copy(source: Path, target: Path) -> None:
    """Both files, the index last: a process that reads in between finds no library."""
    with tempfile.TemporaryDirectory(prefix='.kernels-', dir=target) as work:
        for name in (library.LIBRARY, library.INDEX):
            shutil.copy2(source / name, Path(work) / name)
        (target / library.INDEX).unlink(missing_ok=True)
        for name in (library.LIBRARY, library.INDEX):
            os.replace(Path(work) / name, target / name)
