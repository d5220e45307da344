# SPDX-License-Identifier: Apache-2.0
"""``rlml map merge``: two saved maps as one, aligned by the reflectors that both have."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from rlml_slam import warm_up
from rlml_slam.maps import map_container
from rlml_slam.params import Parameters, from_mapping, read_yaml
from rlml_slam.slam.store import map_file
from rlml_slam.slam.store.map_merging import merge_maps


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map merge``."""
    parser = subparsers.add_parser(
        'merge',
        help='two saved maps as one',
        description='Puts the second map where its reflectors fit those of the first, matches its '
        'scans there, and solves the whole graph. Refused where the reflectors fit in several '
        'places or in none.',
    )
    parser.add_argument('first', metavar='A', type=Path, help='map.rlml; its frame is kept')
    parser.add_argument('second', metavar='B', type=Path, help='map.rlml')
    parser.add_argument('--out', metavar='C', type=Path, required=True, help='the map of both')
    parser.add_argument('--config', metavar='YAML', type=Path, help='ROS parameter file')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Merge, save, and say what came of it."""
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    warm_up.compile_loaded()
    first, second = map_file.load(args.first), map_file.load(args.second)
    merged = merge_maps(first, second, params)
    map_container.write(args.out, merged.content)
    figures = {
        'T_first_second': merged.T_first_second.tolist(),
        'why': merged.why,
        'keyframes': len(merged.back_end.keyframes),
        'reflectors': len(merged.back_end.reflector_graph.keys()),
        'reflectors_in_both': merged.joined,
        'closures_between': merged.closures,
    }
    print(json.dumps(figures) if args.json else text(figures, args.out))
    return 0


def text(f: dict[str, Any], out: Path) -> str:
    """The figures for people."""
    x, y, theta = f['T_first_second']
    return (
        f'the second map lies at x = {x:.3f} m, y = {y:.3f} m, {math.degrees(theta):.2f}°: '
        f'{f["why"]}\n'
        f'{f["reflectors_in_both"]} reflectors in both, {f["closures_between"]} loop closures '
        f'between them\n'
        f'{out}: {f["keyframes"]} keyframes, {f["reflectors"]} reflectors'
    )
