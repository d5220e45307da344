# SPDX-License-Identifier: Apache-2.0
"""One map has one id: in its file and in /diagnostics of every node that uses it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, messages

from rlml_slam.cli.main import main
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.deformable_slam import DeformableSlamNode
from rlml_slam.nodes.ekf_slam import EkfSlamNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.params import Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Odometry, Scan

NONE = 'none: a map in the making'


@pytest.fixture(scope='module')
def file(tmp_path_factory):
    slam = Slam(Parameters())
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}
    for m in messages(ROOM, drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0)), rng=np.random.default_rng(0)):
        add[type(m)](m)
    slam.finish()
    path = tmp_path_factory.mktemp('maps') / 'map.rlml'
    return map_file.save(path, slam.back_end, Parameters())


@pytest.fixture
def id_of_file(file, capsys):
    assert main(['map', 'info', str(file), '--json']) == 0
    return json.loads(capsys.readouterr().out)['id']


def assert_shown(live, node, map_id):
    """It is in the /diagnostics of a node; what was sent before the map came may come late."""
    name = node.get_fully_qualified_name().lstrip('/')

    def values():
        return [
            v.value
            for msg in live.heard['/diagnostics'] for s in msg.status if s.name.startswith(name)
            for v in s.values if v.key == 'map id'
        ]  # fmt: skip

    live.heard['/diagnostics'].clear()
    node.health.publish()
    live.spin_until(lambda: values()[-1:] == [map_id])


def test_every_node_that_localizes_in_a_map_shows_its_id(live, file, id_of_file):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    values = {'map_directory': str(file.parent), 'mode': 'localization'}
    front = live.start(FrontEndNode, **values)
    back = live.start(BackEndNode, **values)
    live.spin_until(lambda: front.control.session.map is not None)
    ekf = live.start(EkfSlamNode, **values)
    for node in (front, back, ekf):
        assert_shown(live, node, id_of_file)


def test_node_that_makes_a_map_shows_none(live, tmp_path):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    values = {'map_directory': str(tmp_path)}
    for kind in (FrontEndNode, BackEndNode, EkfSlamNode):
        assert_shown(live, live.start(kind, **values), NONE)
    assert_shown(live, live.start(DeformableSlamNode), NONE)


def test_id_is_stored_and_differs_with_every_part_of_the_map(file, id_of_file):
    content = map_file.load(file)
    assert content.description['id'] == id_of_file
    saved = map_file.saved_map(content)
    assert saved.id == id_of_file
    moved = replace(saved.reflectors, points=saved.reflectors.points + 1e-6)
    cells = saved.grid.cells.copy()
    cells[0, 0] += 1
    others = [
        replace(saved, reflectors=moved),
        replace(saved, grid=None),
        replace(saved, grid=replace(saved.grid, cells=cells)),
        replace(saved, grid=replace(saved.grid, origin=(0.0, 0.0))),
    ]
    assert len({saved.id, *(other.id for other in others)}) == 5
