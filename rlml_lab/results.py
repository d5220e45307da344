# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab results``: the page of benchmarks, made from a file of results.

``docs/benchmarks.json`` has the environments (machine, date, versions) and tables whose rows name
the command that printed them. ``--pins`` takes the figures of a file of ``pins.py --write`` over.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rlml_slam.errors import FileFormatError
from rlml_slam.maps.atomic_file import write_atomically

RESULTS = Path('docs/benchmarks.json')
NOTE = '<!-- made by `rlml-lab results --write docs/benchmarks.md` from docs/benchmarks.json -->'
LIBRARIES = ('numpy', 'scipy', 'numba')
ROBOTS = range(1, 6)


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab results``."""
    parser = subparsers.add_parser(
        'results', help='the page of benchmarks, from docs/benchmarks.json'
    )
    parser.add_argument(
        '--results', type=Path, default=RESULTS, metavar='FILE', help='default: %(default)s'
    )
    parser.add_argument('--write', type=Path, metavar='FILE', help='write the page here')
    parser.add_argument(
        '--pins', type=Path, metavar='FILE',
        help='take the accuracy of replays from a file of pins.py, measured here and today',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Update the results where pins are given; print or write the page."""
    results = read(args.results)
    if args.pins is not None:
        results['environments']['accuracy'] = environment()
        results['tables']['accuracy']['rows'] = accuracy_rows(read(args.pins))
        text = json.dumps(results, indent=1, ensure_ascii=False) + '\n'
        write_atomically(args.results, text.encode())
    text = page(results)
    if args.write is None:
        print(text, end='')
    else:
        write_atomically(args.write, text.encode())
    return 0


def read(path: Path) -> dict[str, Any]:
    """A JSON object of a file; FileFormatError where there is none."""
    try:
        found = json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError) as e:
        raise FileFormatError(f'{path}: cannot be read: {e}') from e
    if not isinstance(found, dict):
        raise FileFormatError(f'{path}: not an object')
    return found


def environment() -> dict[str, str]:
    """Date, machine and versions of a measurement made now."""
    libraries = ', '.join(f'{name} {version(name)}' for name in LIBRARIES)
    return {
        'date': datetime.date.today().isoformat(),
        'machine': _processor(),
        'versions': f'Python {platform.python_version()}, {libraries}',
    }


def _processor() -> str:
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return f'{len(names)} cores of {names[0]}, virtual machine' if names else platform.machine()


def accuracy_rows(pins: Mapping[str, Any]) -> list[list[str]]:
    """Rows of the table of accuracy from the figures of pins.py."""
    figures = {name: case['figures'] for name, case in pins.items()}
    rows = []
    for name, title in (('intel', 'Intel Research Lab'), ('fr079', 'Freiburg 079')):
        f = figures[name]
        error = f'{f["trans_mean_m"]:.4f} m, {f["rot_mean_deg"]:.3f}°'
        rows.append([f'{title}: mean over all relations', error, f'{f["wall_s"]:.0f} s'])
    for suffix, title in (('', 'known ids'), ('_no_ids', 'anonymous')):
        runs = [figures[f'mrclam6_{robot}{suffix}'] for robot in ROBOTS]
        errors = ', '.join(f'{100.0 * f["ate_m"]:.1f}' for f in runs)
        seconds = sum(f['wall_s'] for f in runs)
        rows.append(
            [f'MR.CLAM 6, robots 1 to 5, {title}: ATE', f'{errors} cm', f'{seconds:.0f} s']
        )
    for name, title in (
        ('hall', 'sample bag `bags/hall`: ATE'),
        ('room', 'sample bag `bags/room`: ATE'),
        ('hall_ekf', '`bags/hall`, EKF-SLAM: ATE'),
        ('room_no_odometry', '`bags/room` without odometry: ATE'),
        ('room_map', '`bags/room`, localized in its own map: ATE'),
    ):
        f = figures[name]
        rows.append([title, f'{100.0 * f["ate_m"]:.2f} cm', f'{f["wall_s"]:.1f} s'])
    return rows


def page(results: Mapping[str, Any]) -> str:
    """The page as Markdown."""
    parts = ['# Benchmarks', NOTE, *results['introduction']]
    for name, table in results['tables'].items():
        where = results['environments'][table.get('environment', name)]
        parts += [f'## {table["title"]}', *table['text'], _table(table['columns'], table['rows'])]
        parts.append(f'<small>{where["date"]}; {where["machine"]}; {where["versions"]}.</small>')
    return '\n\n'.join(parts) + '\n'


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = [f'| {" | ".join(columns)} |', '|' + '---|' * len(list(columns))]
    return '\n'.join([*head, *(f'| {" | ".join(row)} |' for row in rows)])
