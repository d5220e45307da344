# SPDX-License-Identifier: Apache-2.0
"""``rlml closures``: the loop closures of a replay, or of a running back end; revoke one there."""

from __future__ import annotations

import argparse
import csv
import io
import json
from pathlib import Path
from typing import Any

from rlml_slam import warm_up
from rlml_slam.cli.support.service_call import ask
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import InputError, MapError, cause
from rlml_slam.maps import map_container
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import COLUMNS, closure_table, describe
from rlml_slam.slam.store import map_file


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml closures``."""
    parser = subparsers.add_parser(
        'closures', help='loop closures of a replay or of a running back end; revoke one'
    )
    parser.add_argument(
        'folder',
        metavar='DIR',
        type=Path,
        nargs='?',
        help='what a replay wrote (closures.csv), or a saved map (map.rlml)',
    )
    parser.add_argument(
        '--node', metavar='NAME', default='/back_end',
        help='without DIR: the running back end (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--revoke', metavar='NUMBER', type=int, help='take it out of its map')
    parser.add_argument('--all', action='store_true', help='also those that are sound')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """List, or revoke."""
    if args.revoke is not None:
        if args.folder is None:
            said = ask(args.node, 'revoke_closure', str(args.revoke))
        elif args.folder.is_file():
            said = revoke(args.folder, args.revoke)
        else:
            raise InputError('--revoke works in a running back end or a saved map: name its file')
        print(json.dumps({'revoked': said}) if args.json else said)
        return 0
    rows = read(args.folder) if args.folder else parse(ask(args.node, 'closures'), args.node)
    if args.json:
        print(json.dumps({'closures': rows}))
    else:
        print(text(rows, args.all))
    return 0


def revoke(path: Path, number: int) -> str:
    """Take a closure out of a saved map; the map before stays beside it."""
    warm_up.compile_loaded()
    content, closure = map_file.revoked(map_file.load(path), number)
    map_container.write(path, content)
    return describe(closure)


def read(folder: Path) -> list[dict[str, str]]:
    """The rows of a folder's closures.csv, or of a saved map; MapError if there is none."""
    whole = folder / 'map.rlml' if folder.is_dir() else folder
    if whole.is_file():  # closures.csv may be of before one was revoked
        back_end = BackEnd(Parameters())
        map_file.restore(map_file.load(whole), back_end)
        return parse(closure_table(back_end.loop_closer.records), str(whole))
    path = folder / 'closures.csv'
    try:
        return parse(path.read_text(encoding='utf-8'), str(path))
    except (OSError, UnicodeDecodeError) as e:
        raise MapError(f'{path}: cannot be read: {cause(e)}') from e


def parse(table: str, name: str) -> list[dict[str, str]]:
    """The rows of a table; InputError, naming it, if it is none of closures."""
    rows = list(csv.DictReader(io.StringIO(table)))
    header = table.partition('\n')[0].split(',')
    if tuple(header) != COLUMNS:
        raise InputError(f'{name}: not a table of loop closures')
    return rows


def text(rows: list[dict[str, str]], everything: bool) -> str:
    """Those that are out of the map or count for less, or all, and how many there are."""
    sound = [r['state'] == 'active' and float(r['weight'] or 1.0) == 1.0 for r in rows]
    shown = [r for r, is_sound in zip(rows, sound, strict=True) if everything or not is_sound]
    columns = COLUMNS[:-1]
    lines = [[r[name] for name in columns] for r in shown]
    states = [r['state'] for r in rows]
    counts = ', '.join(f'{states.count(s)} {s}' for s in ('active', 'disabled', 'revoked'))
    total = f'{len(rows)} loop closures: {counts}'
    if lines:
        return f'{aligned([columns, *lines])}\n{total}'
    return f'{total}; all are sound, --all lists them' if rows else total
