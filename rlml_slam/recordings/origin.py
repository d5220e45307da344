# SPDX-License-Identifier: Apache-2.0
"""What a run was made from, for its report."""

from __future__ import annotations

import hashlib
from pathlib import Path

CHUNK = 1 << 22  # [bytes] that are read at once


def source_of(bag: Path) -> str:
    """Name and SHA-256 of a bag."""
    return f'{bag.resolve().name}, SHA-256 {digest_of(bag)}'


def digest_of(path: Path) -> str:
    """SHA-256 of the names and bytes of a file, or of all files of a folder."""
    seen = hashlib.sha256()
    for file in sorted(path.rglob('*')) if path.is_dir() else [path]:
        if file.is_file():
            seen.update(f'{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0'.encode())
            with file.open('rb') as f:
                while chunk := f.read(CHUNK):
                    seen.update(chunk)
    return seen.hexdigest()
