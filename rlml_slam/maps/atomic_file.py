# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all, even where the power fails."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from rlml_slam.errors import MapError

PREVIOUS = '.previous'


def write_atomically(
    path: Path, *parts: bytes | memoryview, before: Callable[[Path], None] = lambda path: None
) -> None:
    """Write a file so that a reader sees the old one or the new one, never a part.

    ``before`` is called with the path when the new one is on the disk, and has not replaced the
    old one yet. Raises MapError if it cannot be written; then the old one is untouched.
    """
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
        try:
            with os.fdopen(handle, 'wb') as f:
                f.writelines(parts)
                f.flush()
                os.fsync(f.fileno())
            os.chmod(temporary, 0o644)
            before(path)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)
    except OSError as e:
        raise MapError(f'{path}: cannot be written: {e.strerror or e}') from e


def set_aside(*paths: Path) -> None:
    """Name files that are no longer true ``path.previous``, or ``-2``; raises MapError."""
    for path in paths:
        try:
            previous, k = path.with_name(path.name + PREVIOUS), 1
            while path.exists() and previous.exists():
                k += 1
                previous = path.with_name(f'{path.name}{PREVIOUS}-{k}')
            if path.exists():
                os.replace(path, previous)
        except OSError as e:
            raise MapError(f'{path}: cannot be set aside: {e.strerror or e}') from e


def _sync_folder(folder: Path) -> None:
    """Have the names on the disk as well as the bytes."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
