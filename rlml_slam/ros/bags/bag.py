# SPDX-License-Identifier: Apache-2.0
"""Bags: rosbag2 folders and files (sqlite3, mcap) and ROS 1 bags are read, rosbag2 is written.

Nothing here needs a ROS installation. A message that cannot be read never costs the others.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rosbags.interfaces import ConnectionExtRosbag1, MessageDefinitionFormat, Nodetype, Qos
from rosbags.interfaces import QosDurability as Durability
from rosbags.interfaces import QosHistory as History
from rosbags.interfaces import QosLiveliness as Liveliness
from rosbags.interfaces import QosReliability as Reliability
from rosbags.interfaces import QosTime as Span
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from rlml_slam.errors import BagError
from rlml_slam.params import Node
from rlml_slam.ros.bags.bag_recovery import ROSBAG1, BagRecovery, has_wal
from rlml_slam.ros.codecs.message_types import bag_types
from rlml_slam.ros.sensor_input import PLACED, STREAMS, USED_BY, topics_of

TRUTH = 'ground_truth'  # the name of a topic that is no sensor
HINTS = {
    'sensor_msgs/msg/MultiEchoLaserScan': (
        'MultiEchoLaserScan is not read: laser_proc makes a LaserScan of it'),
    'sensor_msgs/msg/PointCloud2': (
        'a PointCloud2 of reflectors is read where reflectors_topic names it'),
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: name, type (ROS 2 spelling) and number of messages."""

    name: str
    msgtype: str
    count: int


class BagReader:
    """A bag opened for reading, as a context manager.

    ``topics`` by name; ``start`` and ``end`` [ns] of the recording; ``skipped`` counts, by topic,
    the messages that ``messages`` left out because their type is unknown or they are broken;
    ``damage`` says in one line what is wrong with a bag that had to be salvaged, empty for a sound
    one.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.skipped: Counter[str] = Counter()
        self.damage = ''
        self._todays: dict[str, bool] = {}
        if not self.path.exists():
            raise BagError(f'{path}: no such bag')
        entries = self.path.iterdir() if self.path.is_dir() else [self.path]
        if all(f.name == 'metadata.yaml' or f.is_dir() for f in entries):
            raise BagError(f'{path}: no bag: there is no recording in this folder')
        self.is_ros1 = _is_ros1(self.path)
        self._reader = self._open()
        self.topics = {
            name: Topic(name, info.msgtype or '', info.msgcount)
            for name, info in self._reader.topics.items()
        }
        self.start = int(self._reader.start_time)
        self.end = int(self._reader.end_time)

    def _open(self) -> Any:
        """The library's reader, or, for a bag that it refuses, what can be salvaged of it."""
        try:
            files = self.path.glob('*.db3') if self.path.is_dir() else [self.path]
            if any(map(has_wal, files)):  # which the library overlooks
                raise BagError('was not closed, and read with its -wal')
            reader: Any = (Reader1 if self.is_ros1 else Reader2)(self.path)
            reader.open()
            _ = reader.topics  # of a topic without a type it can be opened, but not listed
        except Exception as e:  # the library lets struct.error, KeyError and others through
            try:
                reader = BagRecovery(self.path)
            except ValueError:
                raise BagError(f'{self.path}: not a readable bag: {_line(e)}') from e
            except OSError as error:
                raise BagError(f'{self.path}: cannot be read: {error.strerror}') from e
            self.damage = f'{self.path}: {reader.damage or _line(e)}'
        return reader

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def count(self, topics: Collection[str] | None = None) -> int:
        """Number of messages of the topics (all if None), as the bag's index says."""
        return sum(t.count for t in self.topics.values() if topics is None or t.name in topics)

    def is_latched(self, topic: str) -> bool:
        """Whether late subscribers got the topic's last message as well."""
        if topic.endswith('tf_static'):
            return True
        for c in self._reader.connections:
            if c.topic != topic:
                continue
            if isinstance(c.ext, ConnectionExtRosbag1):
                return bool(c.ext.latching)
            offered = c.ext.offered_qos_profiles
            return any(q.durability == Durability.TRANSIENT_LOCAL for q in offered)
        return False

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[int, str, Any]]:
        """Yield (log time [ns], topic, message) in log time order.

        Raises BagError where the bag is damaged, after all that came before the damage.
        """
        for time, connection, raw in self._raw(topics):
            types = _types_of(connection.msgdef, connection.msgtype, self.is_ros1)
            if types is None:
                self.skipped[connection.topic] += 1
                continue
            try:
                read = types.deserialize_ros1 if self.is_ros1 else types.deserialize_cdr
                message = read(raw, connection.msgtype)
            except Exception:  # a broken payload: whatever the generated code stumbles over
                self.skipped[connection.topic] += 1
                continue
            yield time, connection.topic, message

    def serialized(
        self, topics: Collection[str] | None = None
    ) -> Iterator[tuple[int, str, bytes]]:
        """Like ``messages``, but as bytes that ROS 2 publishes as they are.

        Types whose fields are others than Jazzy's are skipped.
        """
        for time, connection, raw in self._raw(topics):
            topic, msgtype = connection.topic, connection.msgtype
            if not self._is_todays(connection):
                self.skipped[topic] += 1
                continue
            if not self.is_ros1:
                yield time, topic, bytes(raw)
                continue
            try:
                data = bytes(bag_types().ros1_to_cdr(raw, msgtype))
            except Exception:  # a broken payload, as in messages
                self.skipped[topic] += 1
                continue
            yield time, topic, data

    def _is_todays(self, connection: Any) -> bool:
        """Whether the type in the bag has the fields of today's; a type of others is believed."""
        msgtype = connection.msgtype
        if msgtype not in self._todays:
            today = bag_types()
            types = _types_of(connection.msgdef, msgtype, self.is_ros1)
            if msgtype in today.fielddefs:
                same = types is not None and _layout(types, msgtype) == _layout(today, msgtype)
            else:
                same = not self.is_ros1
            self._todays[msgtype] = same
        return self._todays[msgtype]

    def _raw(self, topics: Collection[str] | None) -> Iterator[tuple[int, Any, bytes]]:
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        count = 0
        try:
            for connection, time, raw in self._reader.messages(connections=wanted):
                count += 1
                yield int(time), connection, raw
        except GeneratorExit:
            raise
        except Exception as e:
            raise BagError(f'{self.path}: damaged after {count} messages: {_line(e)}') from e


def _is_ros1(path: Path) -> bool:
    """By name or first bytes: a recorder that was killed leaves a ``.bag.active``."""
    with contextlib.suppress(OSError), path.open('rb') as file:  # OSError: also of a folder
        return path.suffix == '.bag' or file.read(len(ROSBAG1)) == ROSBAG1
    return False


@functools.lru_cache(maxsize=100)  # most bags have the same
def _types_of(definition: Any, msgtype: str, is_ros1: bool) -> Any:
    """Types of messages with a definition, None if they are unknown."""
    if definition.format == MessageDefinitionFormat.NONE:
        standard = get_typestore(Stores.ROS1_NOETIC) if is_ros1 else bag_types()
        return standard if msgtype in standard.fielddefs else None
    # a store of its own, so that one strange definition cannot clash with the others
    types = get_typestore(Stores.EMPTY)
    try:
        if definition.format == MessageDefinitionFormat.MSG:
            types.register(get_types_from_msg(definition.data, msgtype))
        else:
            types.register(get_types_from_idl(definition.data))
    except Exception:
        return None
    return types


def _layout(types: Any, msgtype: str) -> Any:
    """The fields of a type, with those of its parts in place of their names."""
    if msgtype == 'std_msgs/msg/Header':  # that of ROS 1 has a counter, which is left out
        return msgtype

    def part(description: Any) -> Any:
        kind, what = description
        if kind == Nodetype.NAME:
            return _layout(types, what)
        return (kind, what) if kind == Nodetype.BASE else (kind, part(what[0]), what[1])

    return [(name, part(description)) for name, description in types.fielddefs[msgtype][1]]


def _line(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return text[0] if text else type(error).__name__


def choose_topics(
    topics: Mapping[str, Topic], node: Node, without: Collection[str] = ('imu',)
) -> dict[str, str]:
    """Which topic of a bag feeds which stream of the sequencer (keys of STREAMS).

    By the parameter's name, else by that name inside a namespace, else the only topic of the
    type. Streams that the parameters switch off are left out, and those ``without`` which it works
    if several fit. Raises BagError, listing the topics, if several fit another one, or if there is
    neither a scan nor a reflector stream.
    """
    chosen: dict[str, str] = {}
    for stream, (parameter, msgtype, fallback, _) in STREAMS.items():
        if not getattr(node, USED_BY[stream]):
            continue
        name = topics_of(node, stream)[0].strip('/')
        typed = [
            t.name for t in topics.values()
            if t.msgtype == msgtype and t.count and t.name.rsplit('/')[-1] != TRUTH
        ]  # fmt: skip
        fitting = (
            [t for t in typed if t.strip('/') == name]
            or [t for t in typed if t.endswith(f'/{name}')]
            or (typed if fallback else [])
        )
        if len(fitting) > 1 and stream in without:
            continue
        if len(fitting) > 1:
            several = ', or several lidars with scan_topics' if stream == 'scan' else ''
            raise BagError(
                f'several topics fit {stream}: {", ".join(sorted(fitting))}; '
                f'name one with the parameter {parameter}{several}, in the YAML file of --config'
            )
        if fitting:
            chosen[stream] = fitting[0]
    if not chosen.keys() & set(PLACED):
        listed = ', '.join(f'{t.name} ({t.msgtype})' for t in topics.values()) or 'nothing'
        kinds = {t.msgtype for t in topics.values()}
        hints = ''.join(f'; {hint}' for kind, hint in HINTS.items() if kind in kinds)
        raise BagError(f'no scan and no reflectors in the bag, which has {listed}{hints}')
    return chosen


_FOREVER = Span(2147483647, 4294967295)
LATCHED = Qos(
    History.KEEP_LAST, 1, Reliability.RELIABLE, Durability.TRANSIENT_LOCAL,
    _FOREVER, _FOREVER, Liveliness.AUTOMATIC, _FOREVER, False,
)  # fmt: skip


class BagWriter:
    """A new rosbag2 folder, as a context manager: it appears whole or, after an error, not at all.

    A ``path`` that ends in .mcap is one file without a folder and its metadata.yaml. The same
    messages in the same order give the same bytes.
    """

    def __init__(self, path: str | Path, storage: Literal['mcap', 'sqlite3'] = 'mcap') -> None:
        self.path = Path(path)
        self._is_file = self.path.suffix == '.mcap'
        if self.path.exists():
            raise BagError(f'{path}: exists already and is not overwritten')
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix='.bag-', dir=self.path.parent))
            plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
            # the name of its folder is in the file
            self._made = self._folder / ('bag' if self._is_file else self.path.name)
            self._writer = Writer(self._made, version=9, storage_plugin=plugin)
            self._writer.open()
        except OSError as e:
            raise BagError(f'{path}: cannot be written: {e.strerror}') from e
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        return self

    def add_topic(self, topic: str, msgtype: str, latched: bool = False) -> None:
        """Announce a topic; ``latched`` ones are offered transient local."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=bag_types(),
                offered_qos_profiles=[LATCHED] if latched else (),
            )  # fmt: skip

    def write(self, topic: str, message: Any, log_time: int) -> None:
        """Append a message made by ``messages.make_bag``; unannounced topics are added."""
        msgtype = message.__msgtype__
        self.add_topic(topic, msgtype)
        self.write_serialized(topic, bag_types().serialize_cdr(message, msgtype), log_time)

    def write_serialized(self, topic: str, data: bytes | memoryview, log_time: int) -> None:
        """Append the bytes (CDR) of a message to a topic that was announced."""
        try:
            self._writer.write(self._connections[topic], int(log_time), data)
        except OSError as e:
            raise BagError(f'{self.path}: cannot be written: {e.strerror}') from e

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._writer.close()
                made = self._made / f'{self._made.name}.mcap' if self._is_file else self._made
                os.rename(made, self.path)
            else:
                self._writer.abort()
        except OSError as e:
            raise BagError(f'{self.path}: cannot be written: {e.strerror}') from e
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)
