# SPDX-License-Identifier: Apache-2.0
"""``study broken-bags``: what can be read of bags that are cut off or damaged.

A recorder that is killed, or a disk that is full, leaves a bag without its end; a bad disk changes
some bytes of it. The library rosbags reads such a bag, or refuses it; ``BagReader`` then reads it
from the front, record by record. A message that was not recorded must never come out.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2

from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import BagError, ParameterError
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs.message_types import bag_types

SAMPLE = Path(__file__).parents[2] / 'bags' / 'room'
BYTES = 4  # that a damaged disk changes
CHUNK = 1 << 16  # [bytes] of a bag of ROS 1, which is short
# a message as recorded: its time [ns], topic and bytes
Raw = tuple[int, str, bytes]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study broken-bags``."""
    parser = subparsers.add_parser(
        'broken-bags',
        help='what can be read of bags that are cut off or damaged',
        description='Shares of the messages that the library rosbags reads of broken bags, and '
        'that this package does. None may be wrong.',
    )
    parser.add_argument('--bags', type=int, default=20, help='per row, default: %(default)s')
    parser.add_argument('--seed', type=int, default=0, help='default: %(default)s')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Break, read, compare; exit code 1 where a message was wrong or recovery has lost any."""
    if args.bags < 1:
        raise ParameterError('study broken-bags: --bags must be at least 1')
    with BagReader(SAMPLE) as bag:
        recorded = [(time, topic, bytes(raw)) for time, topic, raw in bag.serialized()]
        kinds = {t.name: t.msgtype for t in bag.topics.values()}
    rows = {}
    cases = [(form, harm) for form in WRITERS for harm in (cut_off, changed)]
    with tempfile.TemporaryDirectory() as name, Progress('bags', len(cases), args.json) as shown:
        for done, (form, harm) in enumerate(cases, 1):
            title = f'{form}, {harm.__name__.replace("_", " ")}'
            rows[title] = row(Path(name) / title, form, harm, args, recorded, kinds)
            shown.update(done, title)
    print(json.dumps(rows) if args.json else table(rows))
    return int(any(r['wrong'] or r['read'] < r['library'] for r in rows.values()))


def row(
    folder: Path, form: str, harm: Callable[[Path, np.random.Generator], None],
    args: argparse.Namespace, recorded: list[Raw], kinds: dict[str, str],
) -> dict[str, float]:  # fmt: skip
    """Mean shares [%] of the messages by library and package, and the number of wrong ones."""
    rng, true = np.random.default_rng(args.seed), set(recorded)
    library, read, wrong = [], [], 0
    for k in range(args.bags):
        file = WRITERS[form](folder / str(k), recorded, kinds)
        harm(file, rng)
        library.append(len(true & set(by_library(file))))
        found = set(by_package(file))
        read.append(len(true & found))
        wrong += len(found - true) if harm is cut_off else 0
    shares = 100.0 * np.array([library, read]) / len(true)
    return {
        'library': float(shares[0].mean()), 'read': float(shares[1].mean()),
        'least': float(shares[1].min()), 'wrong': wrong,
    }  # fmt: skip


def _mcap(path: Path, recorded: list[Raw], kinds: dict[str, str]) -> Path:
    """One file without metadata.yaml, as a recorder that was killed leaves it."""
    return _rosbag2(path.with_suffix('.mcap'), recorded, kinds)


def _sqlite3(path: Path, recorded: list[Raw], kinds: dict[str, str]) -> Path:
    return next(_rosbag2(path, recorded, kinds).glob('*.db3'))


def _rosbag2(path: Path, recorded: list[Raw], kinds: dict[str, str]) -> Path:
    with BagWriter(path, 'mcap' if path.suffix == '.mcap' else 'sqlite3') as bag:
        for topic, msgtype in kinds.items():
            bag.add_topic(topic, msgtype)
        for time, topic, data in recorded:
            bag.write_serialized(topic, data, time)
    return path


def _ros1(path: Path, recorded: list[Raw], kinds: dict[str, str]) -> Path:
    """A bag of ROS 1, in compressed chunks."""
    path = path.with_suffix('.bag')
    path.parent.mkdir(parents=True, exist_ok=True)
    bag = Writer1(path)
    bag.set_compression(Writer1.CompressionFormat.BZ2)
    bag.chunk_threshold = CHUNK
    with bag:
        types = bag_types()
        links = {t: bag.add_connection(t, m, typestore=types) for t, m in kinds.items()}
        for time, topic, data in recorded:
            bag.write(links[topic], time, bytes(types.cdr_to_ros1(data, kinds[topic])))
    return path


WRITERS = {'MCAP': _mcap, 'SQLite': _sqlite3, 'ROS 1': _ros1}


def cut_off(file: Path, rng: np.random.Generator) -> None:
    """The recorder was killed: no end, and no metadata of it."""
    data = file.read_bytes()
    file.write_bytes(data[: int(rng.uniform(0.1, 1.0) * len(data))])
    (file.parent / 'metadata.yaml').unlink(missing_ok=True)


def changed(file: Path, rng: np.random.Generator) -> None:
    """Some bytes of the file are others."""
    data = bytearray(file.read_bytes())
    for at in rng.integers(len(data), size=BYTES):
        data[at] ^= int(rng.integers(1, 256))
    file.write_bytes(data)


def by_library(file: Path) -> Iterator[Raw]:
    """What rosbags reads before it raises whatever it raises."""
    with contextlib.suppress(Exception):
        path = file.parent if file.suffix == '.db3' else file
        with (Reader1 if file.suffix == '.bag' else Reader2)(path) as bag:
            for c, time, raw in bag.messages():
                if file.suffix == '.bag':
                    raw = bag_types().ros1_to_cdr(raw, c.msgtype)
                yield time, c.topic, bytes(raw)


def by_package(file: Path) -> Iterator[Raw]:
    """What BagReader reads before it says what is wrong."""
    path = file.parent if file.suffix == '.db3' else file
    with contextlib.suppress(BagError), BagReader(path) as bag:
        for time, topic, raw in bag.serialized():
            yield time, topic, bytes(raw)


def table(rows: dict[str, dict[str, float]]) -> str:
    """The rows, aligned."""
    lines = [f'{"bag":<20}  library [%]  package [%]  least [%]  wrong']
    for title, r in rows.items():
        shares = f'{r["library"]:11.1f}  {r["read"]:11.1f}  {r["least"]:9.1f}'
        lines.append(f'{title:<20}  {shares}  {r["wrong"]:5.0f}')
    return '\n'.join(lines)
