# SPDX-License-Identifier: Apache-2.0
"""``rlml map info``: whether a saved map is whole, and what is in it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rlml_slam.maps.map_container import Content
from rlml_slam.slam.store import map_file


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map info``."""
    parser = subparsers.add_parser('info', help='check a saved map and say what is in it')
    parser.add_argument('file', metavar='FILE', type=Path, help='map.rlml')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Print a line per part; an error says what is wrong with the file."""
    figures = {'bytes': args.file.stat().st_size if args.file.is_file() else 0}
    figures |= contents(map_file.load(args.file))
    if args.json:
        print(json.dumps(figures))
    else:
        print('\n'.join(f'{name.replace("_", " ")}: {value}' for name, value in figures.items()))
    return 0


def contents(content: Content) -> dict[str, Any]:
    """How much of everything there is."""
    a = content.arrays
    return {
        'id': map_file.saved_map(content).id,
        'program': content.description['program'],
        'keyframes': len(a['pose']),
        'scans': int((a['key_points'] >= 0).sum()),
        'submaps': len(a['submap_anchor']),
        'edges': int(a['edge_enabled'].sum()),
        'closures': int((a['closure'][:, 2] >= 0).sum()),
        'reflectors': len(a['reflector_map']),
        'sightings': int(a['sighted_enabled'].sum()),
        'frames': len(a['path']),
        'grid': list(a['grid'].shape) if 'grid' in a else None,
    }
