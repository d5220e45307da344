# SPDX-License-Identifier: Apache-2.0
"""Recovery of broken bags: without index, without metadata, cut off, or with damaged chunks.

A recorder that lost its power leaves such files, and the library rosbags refuses all of them. They
are read from the front, record by record, to the first damage; their messages come in the order of
log time. The one use is ``BagRecovery(path)`` in bag.py, in place of the library's reader.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from functools import partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, BinaryIO, TypeAlias

import apsw
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    TopicInfo,
)
from rosbags.rosbag1.reader import Header, ReaderError, decompressors, normalize
from rosbags.rosbag2.storage_mcap import decompress
from rosbags.typesys.msg import normalize_msgtype

MCAP = b'\x89MCAP0\r\n'
ROSBAG1 = b'#ROSBAG V2.0\n'
SQLITE = b'SQLite format 3\0'
SMALLEST_PAGE = 512  # [bytes] of SQLite
Message: TypeAlias = tuple[int, int, bytes]  # connection id, log time [ns], raw
# a connection when it is met, a message, or what is broken
Found: TypeAlias = Connection | Message | str
_FORMATS = {
    'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL
}  # fmt: skip


class Truncated(Exception):
    """The data end inside of a record."""


class BagRecovery:
    """A reader with the interface of rosbags; ``damage`` says in one line what is wrong.

    Raises ValueError if no message can be read.
    """

    def __init__(self, path: Path) -> None:
        self._files = [path]
        self.damage = ''
        if path.is_dir():
            files = [f for f in path.iterdir() if f.suffix in ('.mcap', '.db3')]
            self._files = sorted(files, key=lambda f: (len(f.name), f.name))  # _2 before _10
            if not (path / 'metadata.yaml').exists():
                self.damage = 'has no metadata.yaml'
        self.connections: list[Connection] = []
        self._counts: Counter[int] = Counter()
        self._starts = [2**63 - 1] * len(self._files)  # [ns]
        self._unsorted: set[int] = set()  # files, by number
        self.end_time = 0
        for number in range(len(self._files)):
            self._survey(number)
        self.start_time = min(self._starts, default=2**63 - 1)
        if not self._counts:
            raise ValueError(self.damage or 'it holds no messages')

    def _survey(self, number: int) -> None:
        """Note what a file holds."""
        last = 0
        for found in self._scan(number):
            if isinstance(found, Connection):
                self.connections.append(found)
            elif isinstance(found, str):
                self.damage = found
            else:
                connection, time, _ = found
                self._counts[connection] += 1
                self._starts[number] = min(self._starts[number], time)
                self.end_time = max(self.end_time, time + 1)
                if time < last:
                    self._unsorted.add(number)
                last = time

    def close(self) -> None:
        """Nothing is held open."""

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """Topics with the number of messages that can be read."""
        out: dict[str, TopicInfo] = {}
        for c in self.connections:
            before = out[c.topic].msgcount if c.topic in out else 0
            count = before + self._counts[c.id]
            out[c.topic] = TopicInfo(c.msgtype, c.msgdef, count, [])
        return out

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, log time [ns], raw) in the order of log time."""
        wanted = {c.id: c for c in connections}
        parts = [self._part(number, wanted) for number in range(len(self._files))]
        for connection, time, raw in heapq.merge(*parts, key=lambda m: m[1]):
            if connection in wanted:
                yield wanted[connection], time, raw

    def _part(self, number: int, wanted: Collection[int]) -> Iterator[Message]:
        """The messages of one file by log time, behind an empty one that holds its place."""
        yield -1, self._starts[number], b''  # so that a file is opened when it is its turn
        found = (f for f in self._scan(number) if not isinstance(f, str | Connection))
        messages = (m for m in found if m[0] in wanted)
        yield from _sorted(messages) if number in self._unsorted else messages

    def _scan(self, number: int) -> Iterator[Found]:
        file = self._files[number]
        with file.open('rb') as source:
            magic = source.read(len(SQLITE))
        first = number * 100_000  # ids are unique over several files
        if magic.startswith(MCAP):
            yield from _from_file(file, len(MCAP), partial(_mcap, first=first, owner=self))
        elif magic.startswith(ROSBAG1):
            yield from _from_file(file, len(ROSBAG1), partial(_rosbag1, owner=self))
        elif magic == SQLITE:
            with _with_wal(file) as whole:
                yield from _sqlite(whole, first, self)
        else:
            yield f'{file.name} is no bag'


def _sorted(messages: Iterator[Message]) -> Iterator[Message]:
    """By log time; a temporary file holds them, which may be larger than the memory."""
    index: list[tuple[int, int, int, int]] = []
    with TemporaryFile() as spool:
        at = 0
        for connection, time, raw in messages:
            index.append((time, at, len(raw), connection))
            at += spool.write(raw)
        for time, start, size, connection in sorted(index):
            spool.seek(start)
            yield connection, time, spool.read(size)


def _from_file(
    file: Path, start: int, scan: Callable[[BinaryIO], Iterator[Found]]
) -> Iterator[Found]:
    with file.open('rb') as source:
        source.seek(start)
        try:
            yield from scan(source)
        except Truncated:
            yield f'{file.name} is cut off'
        except (ValueError, LookupError, TypeError, struct.error, ReaderError) as e:
            yield f'{file.name} is damaged: {type(e).__name__}: {e}'


def _exactly(source: BinaryIO, size: int) -> bytes:
    if size > _rest(source):  # before as much memory is asked for
        raise Truncated
    return source.read(size)


def _rest(source: BinaryIO) -> int:
    """Bytes that are left."""
    here = source.tell()
    size = source.seek(0, os.SEEK_END) - here
    source.seek(here)
    return size


# --- MCAP ----------------------------------------------------------------------------------


def _mcap(source: BinaryIO, first: int, owner: Any) -> Iterator[Found]:
    """Records of a file or of a chunk."""
    schemas: dict[int, tuple[str, MessageDefinition]] = {}
    while code := source.read(1):
        if code == MCAP[:1]:
            return  # the closing magic
        (size,) = struct.unpack('<Q', _exactly(source, 8))
        if code == b'\x06':
            yield from _mcap_chunk(source, size, schemas, first, owner)
        else:
            yield from _mcap_record(code, _exactly(source, size), schemas, first, owner)


def _mcap_chunk(
    source: BinaryIO, size: int, schemas: dict[int, Any], first: int, owner: Any
) -> Iterator[Found]:
    head = _exactly(source, 28)
    _, _, raw_size, crc = struct.unpack('<QQQI', head)
    (name_size,) = struct.unpack('<I', _exactly(source, 4))
    compression = _exactly(source, name_size).decode()
    (packed_size,) = struct.unpack('<Q', _exactly(source, 8))
    packed = source.read(min(packed_size, _rest(source)))
    cut = len(packed) != packed_size
    if cut and compression:
        raise Truncated
    try:
        raw = packed if cut else decompress(packed, compression, raw_size, crc)
    except Exception as e:  # whatever a decompressor says about broken data
        yield f'a chunk is broken: {str(e).splitlines()[0] if str(e) else type(e).__name__}'
        return
    chunk = BytesIO(raw)
    while code := chunk.read(1):
        (size,) = struct.unpack('<Q', _exactly(chunk, 8))
        yield from _mcap_record(code, _exactly(chunk, size), schemas, first, owner)
    if cut:
        raise Truncated


def _mcap_record(
    code: bytes, data: bytes, schemas: dict[int, Any], first: int, owner: Any
) -> Iterator[Found]:
    record = BytesIO(data)

    def text() -> str:
        (size,) = struct.unpack('<I', _exactly(record, 4))
        return _exactly(record, size).decode()

    if code == b'\x03':
        (key,) = struct.unpack('<H', _exactly(record, 2))
        name, encoding, definition = text(), text(), text()
        form = _FORMATS.get(encoding, MessageDefinitionFormat.NONE)
        schemas[key] = (name, MessageDefinition(form, definition))
    elif code == b'\x04':
        key, schema = struct.unpack('<HH', _exactly(record, 4))
        name, definition = schemas.get(schema, ('', None))
        known = {c.id for c in owner.connections}
        if definition is not None and first + key not in known:
            ext = ConnectionExtRosbag2('cdr', [])
            yield Connection(first + key, text(), name, definition, '', 0, ext, owner)
    elif code == b'\x05':
        key, _, time, _ = struct.unpack('<HIQQ', _exactly(record, 22))
        yield first + key, time, record.read()


# --- ROS 1 ---------------------------------------------------------------------------------


def _rosbag1(source: BinaryIO, owner: Any) -> Iterator[Found]:
    """Records of a file or of a chunk."""
    while size := source.read(4):
        if len(size) < 4:
            raise Truncated
        header = _header(_exactly(source, struct.unpack('<I', size)[0]))
        (size_of_data,) = struct.unpack('<I', _exactly(source, 4))
        data, code = _exactly(source, size_of_data), header.get_uint8('op')
        if code == 5:
            try:
                chunk = decompressors[header.get_string('compression')](data)
            except Exception as e:
                yield f'a chunk is broken: {str(e).splitlines()[0] if str(e) else "unreadable"}'
                continue
            yield from _rosbag1(BytesIO(chunk), owner)
        elif code == 7:
            number = header.get_uint32('conn')
            if number not in {c.id for c in owner.connections}:
                yield _connection(number, header, _header(data), owner)
        elif code == 2:
            yield header.get_uint32('conn'), header.get_time('time'), data


def _header(data: bytes) -> Header:
    return Header.read(BytesIO(struct.pack('<I', len(data)) + data))


def _connection(number: int, header: Header, about: Header, owner: Any) -> Connection:
    definition = about.get_string('message_definition')
    return Connection(
        number,
        normalize(header.get_string('topic')),
        normalize_msgtype(about.get_string('type')),
        MessageDefinition(MessageDefinitionFormat.MSG, definition),
        '',
        0,
        ConnectionExtRosbag1(None, int(about.get('latching', b'0') == b'1')),
        owner,
    )


# --- SQLite --------------------------------------------------------------------------------


def has_wal(file: Path) -> bool:
    """Whether a ``-wal`` beside it holds the newest part: its recorder was killed."""
    wal = Path(f'{file}-wal')
    return wal.is_file() and wal.stat().st_size > 0


@contextlib.contextmanager
def _with_wal(file: Path) -> Iterator[Path]:
    """The file, or a temporary copy into which SQLite has taken its ``-wal``."""
    if not has_wal(file):
        yield file
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder, file.name)
        shutil.copyfile(file, copy)
        shutil.copyfile(f'{file}-wal', f'{copy}-wal')
        with contextlib.suppress(apsw.Error), closing(apsw.Connection(str(copy))) as base:
            base.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
        yield copy


def _pages(file: Path) -> tuple[int, int]:
    """Size of a page [bytes], and the number of whole ones that the header knows of."""
    with file.open('rb') as source:
        header = source.read(96)
    size = int.from_bytes(header[16:18], 'big')
    size = 1 << 16 if size == 1 else max(size, SMALLEST_PAGE)
    whole = file.stat().st_size // size
    # as SQLite does: the header's number holds where its counters agree
    known = int.from_bytes(header[28:32], 'big') if header[24:28] == header[92:96] else 0
    return size, min(whole, known or whole)


class _WholePages(apsw.VFS):
    """Shows SQLite the whole pages of a file, and a header that says so.

    What is missing at the end of a page, or of the file, SQLite would read as zeros: a message
    would end in zeros that were never recorded.
    """

    def __init__(self, file: Path) -> None:
        self.name = f'whole pages {id(self)}'
        super().__init__(self.name, '')
        self._size, self._pages = _pages(file)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:
        """The one file that is opened."""
        size, pages = self._size, self._pages

        class File(apsw.VFSFile):
            def xFileSize(self) -> int:
                return size * pages

            def xRead(self, amount: int, offset: int) -> bytes:
                data = super().xRead(amount, offset)
                if offset > 28 or len(data) < 32 - offset:
                    return data
                return data[: 28 - offset] + pages.to_bytes(4, 'big') + data[32 - offset :]

        return File('', name, flags)


def _definitions(base: apsw.Connection) -> dict[str, MessageDefinition]:
    """Of the types of messages; most types are known without."""
    found: dict[str, MessageDefinition] = {}
    with contextlib.suppress(apsw.Error):
        for name, encoding, text in base.execute(
            'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
        ):
            form = _FORMATS.get(encoding, MessageDefinitionFormat.NONE)
            found[name] = MessageDefinition(form, text)
    return found


def _sqlite(file: Path, first: int, owner: Any) -> Iterator[Found]:
    pages = _WholePages(file)
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    with closing(apsw.Connection(f'file:{file}?immutable=1', flags, pages.name)) as base:
        try:
            definitions = _definitions(base)
            none = MessageDefinition(MessageDefinitionFormat.NONE, '')
            # the rows of a broken page read as NULL, or as values of any type
            for number, topic, kind in base.execute(
                'SELECT id, name, type FROM topics '
                "WHERE typeof(id) = 'integer' AND typeof(name) = 'text' AND typeof(type) = 'text'"
            ):
                ext = ConnectionExtRosbag2('cdr', [])
                definition = definitions.get(kind, none)
                yield Connection(first + number, topic, kind, definition, '', 0, ext, owner)
            for number, time, data in base.execute(
                'SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE '
                "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' "
                "AND typeof(data) = 'blob' ORDER BY id"
            ):
                yield first + number, time, data
        except (apsw.Error, MemoryError) as e:
            yield f'{file.name} is broken: {e or "a row longer than memory"}'
