# SPDX-License-Identifier: Apache-2.0
"""``rlml map reflectors``: which reflectors of a map are there, new, moved, missing or ghosts."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.service_call import ask
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.landmarks.reflector_states import COLUMNS, state_table
from rlml_slam.slam.store import map_file

ORDER = ('moved', 'missing', 'new', 'ghost', 'present')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map reflectors``."""
    parser = subparsers.add_parser(
        'reflectors',
        help='which reflectors are there, new, moved, missing or ghosts',
        description='Lists the reflectors of a saved map or of a running back end that are not '
        'simply there, or all.',
    )
    parser.add_argument('file', metavar='FILE', type=Path, nargs='?', help='map.rlml')
    parser.add_argument(
        '--node', metavar='NAME', default='/back_end',
        help='without FILE: the running back end (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--all', action='store_true', help='also those that are simply there')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """List them."""
    table = of_file(args.file) if args.file else ask(args.node, 'reflectors')
    rows = list(csv.DictReader(io.StringIO(table)))
    print(json.dumps({'reflectors': rows}) if args.json else text(rows, args.all))
    return 0


def of_file(path: Path) -> str:
    """The table of a saved map."""
    back_end = BackEnd(Parameters())
    map_file.restore(map_file.load(path), back_end)
    return state_table(back_end.reflector_states())


def text(rows: list[dict[str, str]], everything: bool) -> str:
    """The rows in columns, and how many there are of each state."""
    counts = Counter(r['state'] for r in rows)
    shown = [r for r in rows if everything or r['state'] != 'present']
    shown.sort(key=lambda r: ORDER.index(r['state']))
    lines = [[r[name] for name in COLUMNS] for r in shown]
    summary = ', '.join(f'{counts[state]} {state}' for state in ORDER[::-1] if counts[state])
    return f'{aligned([COLUMNS, *lines])}\n{summary or "no reflectors"}'
