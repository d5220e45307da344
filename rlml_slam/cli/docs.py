# SPDX-License-Identifier: Apache-2.0
"""``rlml docs``: the tables of topics, services and parameters in docs, made from the code."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.interface import SERVICES, TOPICS
from rlml_slam.errors import FileFormatError, cause
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.params import (
    Declaration,
    DeformableParameters,
    DetectorParameters,
    Parameters,
    PlayerParameters,
    SimulatorParameters,
    declarations,
)


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml docs``."""
    parser = subparsers.add_parser(
        'docs',
        help='the tables of topics, services and parameters, from the declarations in the code',
        description='Prints the tables, or puts each between its marks in one of the files: '
        '<!-- begin NAME --> and <!-- end NAME -->.',
    )
    parser.add_argument(
        '--write', type=Path, nargs='+', metavar='FILE', help='bring files up to date'
    )


def run(args: argparse.Namespace) -> int:
    """Print the tables or write them."""
    if args.write is None:
        print('\n\n'.join(make() for make in TABLES.values()))
        return 0
    texts = {path: _read(path) for path in args.write}
    for path, text in filled(texts).items():
        write_atomically(path, text.encode())
    return 0


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as e:
        raise FileFormatError(f'{path}: cannot be read: {cause(e)}') from e


def filled(texts: Mapping[Path, str]) -> dict[Path, str]:
    """The texts with every table between its marks made from the code.

    FileFormatError where the marks of a table are not there exactly once among them all.
    """
    made = dict(texts)
    for table, make in TABLES.items():
        begin, end = f'<!-- begin {table} -->', f'<!-- end {table} -->'
        marks = re.compile(f'{re.escape(begin)}.*?{re.escape(end)}', re.DOTALL)
        found = [path for path, text in made.items() for _ in marks.findall(text)]
        if len(found) != 1:
            names = ', '.join(map(str, texts))
            raise FileFormatError(f'{names}: {begin} … {end} is not there exactly once')
        before, after = marks.split(made[found[0]])
        made[found[0]] = f'{before}{begin}\n{make()}\n{end}{after}'
    return made


def topic_table() -> str:
    """All topics of all nodes."""
    rows = [
        (
            t.node, t.direction, f'`{t.name}`' + (f' (`{t.parameter}`)' if t.parameter else ''),
            t.type, t.qos, t.meaning,
        )
        for t in TOPICS
    ]  # fmt: skip
    return _table(('node', '', 'topic (parameter)', 'type', 'QoS', 'meaning'), rows)


def service_table() -> str:
    """All services of all nodes."""
    rows = [(s.node, f'`{s.name}`', s.type, s.meaning) for s in SERVICES]
    return _table(('node', 'service', 'type', 'meaning'), rows)


def parameter_table(of: type[Any], prefix: str = '') -> str:
    """All parameters of a declaration, or those whose names begin with ``prefix``."""
    rows = [
        (f'`{d.name}`', f'`{_value(d.default)}`', d.unit, _range(d), d.meaning + ' ↻' * d.live)
        for d in declarations(of)
        if d.name.startswith(prefix)
    ]
    return _table(('parameter', 'default', 'unit', 'range', 'meaning'), rows)


def _range(d: Declaration) -> str:
    if d.choices:
        return ', '.join(f'`{c}`' for c in d.choices)
    if math.isinf(d.low) and math.isinf(d.high):
        return ''
    return f'{d.low:g} … {d.high:g}'


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f'[{", ".join(_value(v) for v in value)}]'
    if isinstance(value, float):
        return f'{value:.6g}'
    return str(value)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = ['| ' + ' | '.join(head) + ' |', '|' + '---|' * len(head)]
    lines += ['| ' + ' | '.join(cell.replace('|', '\\|') for cell in row) + ' |' for row in rows]
    return '\n'.join(lines)


TABLES: Mapping[str, Callable[[], str]] = {
    'topics': topic_table,
    'services': service_table,
    'parameters': lambda: parameter_table(Parameters),
    'simulator parameters': lambda: parameter_table(SimulatorParameters),
    'deformable parameters': lambda: parameter_table(DeformableParameters, 'deformable.'),
    'detector parameters': lambda: parameter_table(DetectorParameters, 'detector.'),
    'player parameters': lambda: parameter_table(PlayerParameters),
}
