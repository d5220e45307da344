# SPDX-License-Identifier: Apache-2.0
"""Text files of numbers, plain or compressed (gz, xz): their lines, stamps and values."""

from __future__ import annotations

import gzip
import lzma
import math
import zlib
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO, cast

import numpy as np

from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array

SECOND = 1_000_000_000
LATEST = 9_000_000_000  # [s] that 64 bits of nanoseconds hold
MAX_LINE, MAX_SIZE = 1 << 24, 1 << 33  # bytes, unpacked
_GZIP, _XZ = b'\x1f\x8b', b'\xfd7zXZ'


def read_lines(path: str | Path) -> Iterator[tuple[int, str]]:
    """Yield (number from 1, line) of all lines that are neither empty nor a # comment.

    What a file is compressed with is seen from its first bytes, not from its name. Raises
    FileFormatError if it cannot be read or is damaged.
    """
    try:
        with _open(Path(path)) as f:
            size = 0
            for number, raw in enumerate(iter(lambda: f.readline(MAX_LINE), b''), start=1):
                size += len(raw)
                if len(raw) == MAX_LINE or size > MAX_SIZE:
                    raise FileFormatError(f'{path}:{number}: a line or the file is too long')
                line = raw.decode('utf-8-sig', errors='replace').strip()
                if line and not line.startswith('#'):
                    yield number, line
    except (EOFError, lzma.LZMAError, gzip.BadGzipFile, zlib.error) as e:
        raise FileFormatError(f'{path}: the compressed file is damaged: {e}') from e
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e.strerror or e}') from e


def _open(path: Path) -> IO[bytes]:
    with path.open('rb') as f:
        head = f.read(len(_XZ))
    if head.startswith(_GZIP):
        return cast(IO[bytes], gzip.open(path))
    if head == _XZ:
        return lzma.open(path)
    return path.open('rb')


def parse_stamp(word: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly (a float has only some 100 ns left).

    Raises ValueError.
    """
    whole, _, fraction = word.partition('.')
    is_plain = whole.isdecimal() and (fraction.isdecimal() or not fraction)
    if is_plain and len(whole) <= 10 and len(fraction) <= 9 and int(whole) < LATEST:
        return int(whole) * SECOND + int(fraction.ljust(9, '0'))
    try:
        seconds = Decimal(word)
        if abs(seconds) < LATEST:
            return int((seconds * SECOND).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as e:
        raise ValueError(f'{word[:40]!r} is not a time in seconds') from e
    raise ValueError(f'{word[:40]!r} is not a time in seconds')


def format_stamp(stamp: int) -> str:
    """Seconds with all nine decimals of a stamp [ns]."""
    sign = '-' if stamp < 0 else ''
    sec, ns = divmod(abs(int(stamp)), SECOND)
    return f'{sign}{sec}.{ns:09d}'


def parse_numbers(words: Sequence[str]) -> Array:
    """Finite numbers of words; raises ValueError."""
    values = [float(word) for word in words]
    if not all(map(math.isfinite, values)):
        raise ValueError('a number is not finite')
    return np.array(values)
