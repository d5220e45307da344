# SPDX-License-Identifier: Apache-2.0
"""The file of a map: named arrays and a description, with one checksum over all of it.

A header of 64 bytes, then a zip archive, which other tools open as well: ``description.json`` and
a ``NAME.npy`` for each array (numpy's format, without pickled objects). The header, little-endian:

    8 bytes   ``RLMLMAP`` and the version of this layout
    8 bytes   length of the archive [bytes]
    32 bytes  SHA-256 of the archive
    16 bytes  the first 16 of the SHA-256 of the 48 bytes before

So a file that is too short, too long or changed in any bit is detected before it is used.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.atomic_file import PREVIOUS, write_atomically
from rlml_slam.maps.pieces import Pieces

MAGIC, VERSION = b'RLMLMAP', 1
HEAD = struct.Struct('<7sBQ32s')
SIZE = HEAD.size + 16
DESCRIPTION = 'description.json'
PACKED = 1 << 16  # bytes; smaller arrays are not worth a compressor's start
PIECE = 1 << 20  # bytes that are unpacked at a time
UNPACKED = 1 << 28  # bytes that any file may unpack to,
RATIO = 20  # and how many times its own size a larger one
# what the readers of zip, JSON and arrays raise for files that are none of ours
FOREIGN = (
    zipfile.BadZipFile, zlib.error, LookupError, ValueError, TypeError, EOFError, OSError,
    MemoryError, RuntimeError, SyntaxError, struct.error, tokenize.TokenError,
)  # fmt: skip
PLAIN = frozenset('f')  # kinds of numbers that hardly get smaller: measurements


class Content(NamedTuple):
    """Arrays by name, and a description in JSON."""

    arrays: Mapping[str, NDArray[Any]]
    description: Mapping[str, Any]


def write(path: str | Path, content: Content) -> Path:
    """Write a file, whole or not at all; the one that it replaces stays as ``path.previous``.

    At every moment one of the two is whole, whatever happens. Raises MapError if it cannot be
    written; then the old one is untouched.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise MapError(f'{path}: cannot be written: {e.strerror or e}') from e
    write_atomically(path, *pack(content), before=_keep_previous)
    return path


def pack(content: Content) -> tuple[bytes, memoryview]:
    """The header and the archive, which together are the bytes of a file."""
    body = _archive(content)
    head = HEAD.pack(MAGIC, VERSION, len(body), hashlib.sha256(body).digest())
    return head + hashlib.sha256(head).digest()[:16], body


def read_pieces(path: Path) -> Iterator[Content]:
    """The contents in a file to which containers were appended, up to the first damaged one.

    Raises MapError if it cannot be read.
    """
    try:
        with path.open('rb') as f:
            while head := f.read(SIZE):
                body = memoryview(f.read(_length(path, head)))
                yield _unpacked(path, _checked(path, head, body))
    except OSError as e:
        raise MapError(f'{path}: cannot be read: {e.strerror or e}') from e
    except FileFormatError:
        return


def _keep_previous(path: Path) -> None:
    """Give the file that is there a second name, in one step: it is never without one.

    A damaged one is not kept in the place of a good one.
    """
    previous = path.with_name(path.name + PREVIOUS)
    if not path.exists() or (previous.exists() and not _is_whole(path)):
        return
    second = path.with_name(f'.{path.name}{PREVIOUS}.{os.getpid()}')
    second.unlink(missing_ok=True)
    try:
        try:
            os.link(path, second)
        except OSError:  # FAT and some shares have no second names
            shutil.copy2(path, second)
        os.replace(second, previous)
    finally:
        second.unlink(missing_ok=True)


def _is_whole(path: Path) -> bool:
    try:
        _body(path)
    except (MapError, FileFormatError):
        return False
    return True


def _archive(content: Content) -> memoryview:
    out = io.BytesIO()
    with zipfile.ZipFile(out, 'w', compresslevel=1) as archive:
        text = json.dumps(content.description, indent=1, sort_keys=True)
        archive.writestr(_member(DESCRIPTION), text.encode())
        for name, array in content.arrays.items():
            plain = array.dtype.kind in PLAIN or array.nbytes < PACKED
            member = _member(f'{name}.npy', zipfile.ZIP_STORED if plain else zipfile.ZIP_DEFLATED)
            with archive.open(member, 'w', force_zip64=array.nbytes > 1 << 30) as f:
                _write_array(f, array)
    return out.getbuffer()


def _write_array(f: IO[bytes], array: NDArray[Any] | Pieces) -> None:
    """In numpy's format."""
    if not isinstance(array, Pieces):
        npy.write_array(f, np.ascontiguousarray(array), allow_pickle=False)
        return
    descr = npy.dtype_to_descr(array.dtype)
    npy.write_array_header_1_0(
        f, {'descr': descr, 'fortran_order': False, 'shape': array.shape}
    )  # fmt: skip
    for piece in array.pieces():
        f.write(piece.data)


def _member(name: str, method: int = zipfile.ZIP_STORED) -> zipfile.ZipInfo:
    """A member without a date, so that equal maps are equal files."""
    info = zipfile.ZipInfo(name)
    info.compress_type = method
    return info


def read(path: str | Path) -> Content:
    """The content of a file, checked as a whole before anything is used.

    Raises MapError if there is none, FileFormatError saying what is wrong with it and, where there
    is one, which older file is whole.
    """
    path = Path(path)
    try:
        return _unpacked(path, _body(path))
    except FileFormatError as e:
        previous = path.with_name(path.name + PREVIOUS)
        if previous.exists() and _is_whole(previous):
            raise FileFormatError(f'{e}; the map before it is whole: {previous}') from e
        raise


def require(path: Path, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, str]) -> None:
    """Refuse arrays of other ``shapes``, such as ``'n 2'``; one letter has one size everywhere."""
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        a, wanted = arrays.get(name), shape.split()
        if a is None or a.dtype.kind not in 'fi' or a.ndim != len(wanted) or any(
            n != (int(w) if w.isdigit() else sizes.setdefault(w, n))
            for n, w in zip(a.shape, wanted, strict=True)
        ):  # fmt: skip
            raise FileFormatError(f'{path}: {name} is not an array of {shape} numbers')


def _body(path: Path) -> memoryview:
    """The archive in a file, after all checks."""
    try:
        data = memoryview(path.read_bytes())
    except OSError as e:
        raise MapError(f'{path}: cannot be read: {e.strerror or e}') from e
    return _checked(path, bytes(data[:SIZE]), data[SIZE:])


def _length(path: Path, head: bytes) -> int:
    """How many bytes an archive has by its header, after all checks of the header."""
    if head[:7] != MAGIC or len(head) < SIZE:
        raise FileFormatError(f'{path}: not a map, or cut off within its first {SIZE} bytes')
    if hashlib.sha256(head[: HEAD.size]).digest()[:16] != head[HEAD.size :]:
        raise FileFormatError(f'{path}: damaged: the header does not fit its checksum')
    _, version, length, _ = HEAD.unpack(head[: HEAD.size])
    if version != VERSION:
        raise FileFormatError(f'{path}: layout {version}, this program reads {VERSION}')
    return int(length)


def _checked(path: Path, head: bytes, body: memoryview) -> memoryview:
    """The archive, after all checks."""
    length = _length(path, head)
    if len(body) != length:
        raise FileFormatError(f'{path}: damaged: {len(body)} bytes instead of {length}')
    if hashlib.sha256(body).digest() != HEAD.unpack(head[: HEAD.size])[3]:
        raise FileFormatError(f'{path}: damaged: the content does not fit its checksum')
    return body


def _unpacked(path: Path, body: memoryview) -> Content:
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > max(UNPACKED, RATIO * len(body)):
                raise ValueError(f'{len(body)} bytes would become {size}')
            description = json.loads(archive.read(DESCRIPTION))
            for name in archive.namelist():
                if name.endswith('.npy'):
                    with archive.open(name) as f:
                        arrays[name.removesuffix('.npy')] = _array(f)
    # a checksum that fits says that the file is as it was written, not that we wrote it
    except FOREIGN as e:
        raise FileFormatError(f'{path}: not a map of this program: {e}') from e
    if not isinstance(description, dict):
        raise FileFormatError(f'{path}: not a map of this program: it has no description')
    return Content(arrays, description)


def _array(f: IO[bytes]) -> NDArray[Any]:
    """The array of a file in numpy's format; ValueError where it declares another size."""
    version = npy.read_magic(f)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, is_fortran, dtype = read(f)
    data = bytearray()  # the numbers are there once, whatever their size
    for piece in iter(lambda: f.read(PIECE), b''):
        data += piece
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f'an array of {shape} {dtype} in {len(data)} bytes')
    return np.frombuffer(data, dtype).reshape(shape, order='F' if is_fortran else 'C')
