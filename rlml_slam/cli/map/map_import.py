# SPDX-License-Identifier: Apache-2.0
"""``rlml map import``: files that ``rlml map export`` wrote, or other tools, as a saved map.

With graph.g2o and keyframes.tum the map is the graph, with keyframes that have no scans. Without
these, reflectors.csv alone makes it: each reflector held where the table says, as well as it says.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import warm_up
from rlml_slam.cli.map.map_info import contents
from rlml_slam.datasets.tum import read_tum
from rlml_slam.errors import FileFormatError, InputError, MapError
from rlml_slam.graph import Graph, read_graph
from rlml_slam.maps import map_container, nav2_map, reflector_file
from rlml_slam.maps.map_container import Content
from rlml_slam.params import Parameters
from rlml_slam.se2 import between
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.landmarks.landmark import SIGHTING
from rlml_slam.slam.store import map_file
from rlml_slam.types import Reflectors

NEAR = 1e-5  # [m] between a reflector of the table and of the graph: the table has six decimals


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map import``."""
    parser = subparsers.add_parser(
        'import',
        help='text files as a saved map: CSV, g2o, PGM and YAML',
        description='Reads reflectors.csv, where they are there graph.g2o with keyframes.tum, and '
        'map.yaml with its image. What is made of it is to localize in and to go on with.',
    )
    parser.add_argument('folder', metavar='DIR', type=Path, help='what export wrote')
    parser.add_argument('file', metavar='FILE', type=Path, help='map.rlml')


def run(args: argparse.Namespace) -> int:
    """Read, save, and say what is in it."""
    warm_up.compile_loaded()
    if args.file.suffix != '.rlml':
        raise InputError(f'{args.file}: the name of a whole map ends with .rlml')
    content = import_map(args.folder)
    map_container.write(args.file, content)
    figures = contents(content)
    print(f'{args.file}: {figures["keyframes"]} keyframes, {figures["reflectors"]} reflectors')
    return 0


def import_map(folder: Path) -> Content:
    """The map of a folder. Raises MapError or FileFormatError that says which file is wrong."""
    known = reflector_file.load(folder / 'reflectors.csv')
    if (folder / 'graph.g2o').exists():
        graph, keys = _graph(folder)
    else:
        graph, keys = _table_alone(known), [_key(0, 0, np.zeros(3))]
    params, meta = Parameters(), folder / 'map.yaml'
    back_end = BackEnd(params)
    arrays: dict[str, NDArray[Any]] = {
        'pose': graph.poses, 'pose_fixed': graph.fixed_poses,
        'landmark': graph.landmarks, 'landmark_fixed': graph.fixed_landmarks,
        **map_file.arrays_of(keys), **back_end.scan_graph.arrays(),
        **back_end.loop_closer.arrays(), **back_end.frame_trajectory.arrays(),
        'path_motion': between(graph.poses[:-1], graph.poses[1:]).reshape(-1, 3),
        **_reflectors(known, graph, folder),
    }  # fmt: skip
    for name, table in map_file.tables(graph).items():
        for column in map_file.COLUMNS:
            arrays[f'{name}_{column}'] = getattr(table, column)
    map_file.restore(Content(arrays, {}), back_end)
    grid = nav2_map.load(meta) if meta.exists() else None
    return map_file.content_of(back_end, params, grid)


def _graph(folder: Path) -> tuple[Graph, list[Keyframe]]:
    graph = read_graph(folder / 'graph.g2o').graph
    stamps = read_tum(folder / 'keyframes.tum').stamps.tolist()
    if len(stamps) != len(graph.poses):
        raise FileFormatError(
            f'{folder}: keyframes.tum has {len(stamps)} poses, graph.g2o {len(graph.poses)}'
        )
    return graph, [_key(k, s, graph.poses[k]) for k, s in enumerate(stamps)]


def _table_alone(known: Reflectors) -> Graph:
    """Reflectors with priors, and a pose at the origin for what is seen next."""
    if not len(known):
        raise MapError('reflectors.csv has no reflector, and there is no graph.g2o')
    graph = Graph()
    graph.add_pose(np.zeros(3), fixed=True)
    for point, cov in zip(known.points, known.cov, strict=True):
        index = graph.add_landmark(point)
        graph.add_landmark_prior(index, point, np.linalg.inv(cov + 1e-8 * np.eye(2)))
    return graph


def _key(index: int, stamp: int, pose: NDArray[np.float64]) -> Keyframe:
    return Keyframe(index, stamp, pose.copy(), np.zeros((3, 3)), None, None, stamp)


def _reflectors(known: Reflectors, graph: Graph, folder: Path) -> dict[str, NDArray[Any]]:
    """The table's reflectors, each with its landmark and the sightings that the graph has."""
    gap = np.linalg.norm(known.points[:, None] - graph.landmarks[None], axis=-1)
    lost = np.flatnonzero(gap.min(axis=1, initial=np.inf) > NEAR)
    if len(lost):
        raise FileFormatError(
            f'{folder}: reflector {known.keys[lost[0]]} of reflectors.csv is not in graph.g2o'
        )
    node, s = gap.argmin(axis=1), graph.sightings
    seen = s.nodes.reshape(-1, 2)
    rows, together = [], []
    for key, landmark in zip(known.keys.tolist(), node.tolist(), strict=True):
        factor = np.flatnonzero(seen[:, 1] == landmark)
        row = np.zeros(len(factor), dtype=SIGHTING)
        row['pose'], row['factor'] = seen[factor, 0], factor
        row['z'], row['information'] = s.measured[factor], s.information[factor]
        rows.append(row)
        others = np.unique(seen[np.isin(seen[:, 0], row['pose']), 1])
        together += [(key, int(k)) for k in known.keys[np.isin(node, others)]]
    return {
        'reflector_key': known.keys, 'reflector_node': node, 'reflector_id': known.ids,
        'reflector_diameter': known.diameters, 'reflector_count': known.sightings,
        'reflector_sightings': np.array([len(row) for row in rows], dtype=np.int64),
        'reflector_seen_together': np.array(together, dtype=np.int64).reshape(-1, 2),
        'reflector_alias': np.zeros((0, 2), dtype=np.int64),
        'sighting': np.concatenate([np.zeros(0, dtype=SIGHTING), *rows]),
    }  # fmt: skip
