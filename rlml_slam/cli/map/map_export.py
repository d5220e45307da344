# SPDX-License-Identifier: Apache-2.0
"""``rlml map export``: a saved map as files that other tools and people read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rlml_slam.datasets.tum import Trajectory, write_tum
from rlml_slam.graph import Graph, write_graph
from rlml_slam.maps import nav2_map, reflector_file
from rlml_slam.maps.map_container import Content
from rlml_slam.report.outputs import make_folder
from rlml_slam.slam.back_end import trajectory as frame_path
from rlml_slam.slam.store import map_file


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map export``."""
    parser = subparsers.add_parser(
        'export',
        help='a saved map as text: CSV, g2o, TUM, PGM and YAML',
        description='Writes graph.g2o, reflectors.csv, keyframes.tum, trajectory.tum, and where '
        'there are scans map.pgm and map.yaml.',
    )
    parser.add_argument('file', metavar='FILE', type=Path, help='map.rlml')
    parser.add_argument('out', metavar='DIR', type=Path, help='results go here')


def run(args: argparse.Namespace) -> int:
    """Write the files and name them."""
    names = export(map_file.load(args.file), make_folder(args.out))
    print('\n'.join(str(args.out / name) for name in names))
    return 0


def export(content: Content, folder: Path) -> list[str]:
    """Write into a folder; the names of the files."""
    a = content.arrays
    graph = Graph()
    map_file.fill(graph, a)
    write_graph(folder / 'graph.g2o', graph)
    known = map_file.saved_map(content)
    reflector_file.save(known.reflectors, folder / 'reflectors.csv')
    write_tum(folder / 'keyframes.tum', Trajectory(a['key_stamp'], a['pose']))
    poses = frame_path.poses_of(a['path'], a['path_motion'], a['pose'])
    write_tum(folder / 'trajectory.tum', Trajectory(a['path']['stamp'], poses))
    names = ['graph.g2o', 'reflectors.csv', 'keyframes.tum', 'trajectory.tum']
    return names + nav2_map.save_grid(known.grid, folder)
