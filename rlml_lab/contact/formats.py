# SPDX-License-Identifier: Apache-2.0
"""A good file of every format that is read, and what reads it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags import rosbag1
from rosbags.typesys import Stores, get_typestore

from rlml_lab.contact.good_messages import ROOM
from rlml_slam.api import Bag, Slam
from rlml_slam.datasets.carmen import read_carmen
from rlml_slam.datasets.tum import read_tum
from rlml_slam.evaluation.relations import read_relations
from rlml_slam.graph.g2o import read_graph
from rlml_slam.maps import map_container, nav2_map, reflector_file, survey
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters, Simulator, from_mapping, read_yaml
from rlml_slam.ros.back_end.last_pose import LastPose
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.store import map_file
from rlml_slam.slam.store.journal import Journal, recover
from rlml_slam.types import Reflectors

Read = Callable[[Path], Any]


@dataclass(frozen=True)
class Format:
    """``name`` of a file with its suffix, its good bytes, and what reads it.

    With ``contents``, what is in these containers is changed and their checksums fit again.
    """

    name: str
    data: bytes
    read: Read
    is_text: bool = True
    contents: tuple[Content, ...] = ()


def formats(folder: Path) -> Iterator[Format]:
    """All formats; a ``folder`` is needed to write the good files."""
    yield from _texts()
    yield from _grids(folder)
    yield from _bags(folder)
    yield from _maps(folder)


def _texts() -> list[Format]:
    n = 5
    posts = Reflectors(
        np.arange(n), np.arange(2.0 * n).reshape(n, 2), np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        np.full(n, -1), np.full(n, 4), np.full(n, 0.06),
    )  # fmt: skip
    table = reflector_file.reflector_table(posts)
    plan = 'id,x,y,diameter\n' + ''.join(f'{k},{1.5 * k},{k % 3},0.08\n' for k in range(9))
    imk = 'globID x y type subtype size layer\n' + ''.join(
        f'{k} {1000 * k} {700 * (k % 3)} 1 1 80 1\n' for k in range(1, 9)
    )
    stones = json.dumps([{'id': k, 'x': 1.0 * k, 'y': 2.0, 'diameter': 0.1} for k in range(9)])
    pose = json.dumps({'x': 1.0, 'y': 2.0, 'theta': 0.1, 'stamp': 12})
    ranges = ' '.join(['1.5'] * 180)
    carmen = ''.join(
        f'ODOM {k} 0.1 0.0 0.1 0.2 0 {k}.5 host 0.1\n'
        f'FLASER 180 {ranges} {k} 0.1 0.0 {k} 0.1 0.0 {k}.5 host 0.1\n'
        for k in range(1, 5)
    )
    g2o = ''.join(f'VERTEX_SE2 {k} {k}.0 0.5 0.1\n' for k in range(6)) + ''.join(
        f'EDGE_SE2 {k} {k + 1} 1 0 0 100 0 0 100 0 400\n' for k in range(5)
    )
    toro = ''.join(f'VERTEX2 {k} {k}.0 0.5 0.1\n' for k in range(6)) + ''.join(
        f'EDGE2 {k} {k + 1} 1 0 0 100 0 100 400 0 0\n' for k in range(5)
    )
    tum = ''.join(f'{k}.5 {k} 0.5 0 0 0 0 1\n' for k in range(9))
    relations = ''.join(f'{k}.5 {k + 1}.5 1 0 0 0 0 0.1\n' for k in range(9))
    root = Path(__file__).resolve().parents[2]
    world = (root / 'rlml_slam/simulation/worlds/room.yaml').read_bytes()
    config = (root / 'config/default.yaml').read_bytes()[:3000]
    made: list[tuple[str, str | bytes, Read]] = [
        ('reflectors.csv', table, reflector_file.load), ('survey.csv', plan, survey.load),
        ('survey.json', stones, survey.load), ('survey.imk', imk, survey.load),
        ('map.pose', pose, lambda path: LastPose(path).read()),
        ('log.carmen', carmen, read_carmen),
        ('graph.g2o', g2o, read_graph), ('toro.graph', toro, read_graph),
        ('path.tum', tum, read_tum), ('log.relations', relations, read_relations),
        ('world.yaml', world, load_world),
        ('config.yaml', config, lambda path: from_mapping(read_yaml(path, Parameters))),
    ]  # fmt: skip
    return [
        Format(name, data.encode() if isinstance(data, str) else data, read)
        for name, data, read in made
    ]


def _grids(folder: Path) -> list[Format]:
    grid = OccupancyGrid(0.05, (0.0, 0.0), np.zeros((40, 40), dtype=np.int8))
    pgm, meta = nav2_map.save(grid, folder / 'grid')
    text = meta.read_text(encoding='utf-8')

    def read_image(path: Path) -> None:
        """The image, by a description beside it."""
        beside = path.with_suffix('.yaml')
        beside.write_text(text.replace(pgm.name, path.name), encoding='utf-8')
        nav2_map.load(beside)

    out = [Format('map.yaml', text.encode(), nav2_map.describe)]
    with Image.open(pgm) as image:
        for kind in ('pgm', 'png', 'bmp', 'jpeg'):
            path = folder / f'image.{kind}'
            image.save(path)
            out.append(Format(path.name, path.read_bytes(), read_image, False))
    return out


def _maps(folder: Path) -> list[Format]:
    """A map and its journal: their bytes, and what is inside of their containers."""
    slam, bag = Slam(sensor_poses={'laser': Simulator().laser_pose}), Bag(ROOM)
    params = slam.parameters
    back_end, log = BackEnd(params), Journal(params)
    for measurement in bag:
        if measurement.stamp > bag.start + 2 * SECOND:
            break
        for frame in slam.add(measurement):
            log.add(frame, back_end.add(frame) is not None)
    content = map_file.content_of(back_end, params, back_end.occupancy_grid())
    with (folder / 'journal').open('wb') as file:
        log.write(file)
    head, piece = map_container.read_pieces(folder / 'journal')
    return [
        Format('map.rlml', b''.join(map_container.pack(content)), read_map, False),
        Format('content.rlml', b'', read_map, False, (content,)),
        Format('journal', (folder / 'journal').read_bytes(), recover, False),
        Format('content.journal', b'', recover, False, (head, piece)),
    ]


def read_map(path: Path) -> None:
    """Everything of a map: what is localized in, and the graph."""
    content = map_file.load(path)
    map_file.saved_map(content)
    map_file.restore(content, BackEnd(map_file.parameters_of(content)))


def _bags(folder: Path) -> list[Format]:
    out = []
    with BagReader(ROOM) as bag:
        messages = [
            (time, topic, message) for time, topic, message in bag.messages()
            if time < bag.start + SECOND // 2
        ]  # fmt: skip
    for storage in ('mcap', 'sqlite3'):
        with BagWriter(folder / storage, storage) as writer:
            for time, topic, message in messages:
                writer.write(topic, message, time)
        (file,) = (f for f in (folder / storage).iterdir() if f.suffix != '.yaml')
        out.append(Format(f'bag{file.suffix}', file.read_bytes(), read_bag, False))
    types = get_typestore(Stores.ROS1_NOETIC)
    text = types.types['std_msgs/msg/String']
    with rosbag1.Writer(folder / 'one.bag') as old:
        connection = old.add_connection('/text', text.__msgtype__, typestore=types)
        for k in range(50):
            data = types.serialize_ros1(text(data='text' * k), text.__msgtype__)
            old.write(connection, k * SECOND, data)
    out.append(Format('one.bag', (folder / 'one.bag').read_bytes(), read_bag, False))
    return out


def read_bag(path: Path) -> None:
    """All messages of a bag."""
    with BagReader(path) as bag:
        for _ in bag.messages():
            pass
