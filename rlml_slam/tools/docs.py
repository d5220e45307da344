# SPDX-License-Identifier: Apache-2.0
"""``rlml docs``: the README's tables of topics, services and parameters, made from the code."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rlml_slam.errors import FileFormatError
from rlml_slam.maps.atomic import write_atomically
from rlml_slam.params import (
    CarrierParameters,
    Declaration,
    DeformableParameters,
    DetectorParameters,
    Parameters,
    PlayerParameters,
    SimulatorParameters,
    declarations,
)
from rlml_slam.tools.interface import SERVICES, TOPICS


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml docs``."""
    parser = subparsers.add_parser(
        'docs',
        help="the README's tables from the declarations in the code",
        description='Prints the tables, or puts them between the marks of a file: '
        '<!-- begin NAME --> and <!-- end NAME -->.',
    )
    parser.add_argument('--write', type=Path, metavar='README', help='bring a file up to date')


def run(args: argparse.Namespace) -> int:
    """Print the tables or write them."""
    if args.write is None:
        print('\n\n'.join(make() for make in TABLES.values()))
        return 0
    try:
        text = args.write.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as e:
        raise FileFormatError(f'{args.write}: cannot be read: {e}') from e
    write_atomically(args.write, filled(text, str(args.write)).encode())
    return 0


def filled(text: str, name: str = 'text') -> str:
    """The text with every table between its marks made anew; FileFormatError without marks."""
    for table, make in TABLES.items():
        begin, end = f'<!-- begin {table} -->', f'<!-- end {table} -->'
        marks = re.compile(f'{re.escape(begin)}.*?{re.escape(end)}', re.DOTALL)
        if len(marks.findall(text)) != 1:
            raise FileFormatError(f'{name}: {begin} … {end} is not there exactly once')
        before, after = marks.split(text)
        text = f'{before}{begin}\n{make()}\n{end}{after}'
    return text


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
        (f'`{d.name}`', f'`{_value(d.default)}`', d.unit, _range(d), d.meaning)
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
    'carrier parameters': lambda: parameter_table(CarrierParameters),
    'player parameters': lambda: parameter_table(PlayerParameters),
}
