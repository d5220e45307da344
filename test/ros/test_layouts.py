# SPDX-License-Identifier: Apache-2.0
"""The layouts for RViz and Foxglove name what the nodes have, with the right types."""

from __future__ import annotations

import json
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import yaml

from rlml_slam.cli.support.interface import SERVICES, TOPICS

ROOT = Path(__file__).resolve().parents[2]
RVIZ = yaml.safe_load((ROOT / 'config' / 'rlml_slam.rviz').read_text())
FOXGLOVE = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
NAMES = {t: '/' + t.name.replace('~', t.node).lstrip('/') for t in TOPICS}
TYPES = {NAMES[t]: t.type for t in TOPICS}
QOS = {NAMES[t]: t.qos for t in TOPICS}
# display or tool of RViz -> what it takes; others have no topic
TAKES = {
    'Map': 'nav_msgs/OccupancyGrid',
    'Path': 'nav_msgs/Path',
    'MarkerArray': 'visualization_msgs/MarkerArray',
    'PointCloud2': 'sensor_msgs/PointCloud2',
    'LaserScan': 'sensor_msgs/LaserScan',
    'PoseWithCovariance': 'geometry_msgs/PoseWithCovarianceStamped',
    'SetInitialPose': 'geometry_msgs/PoseWithCovarianceStamped',
}


def parts(of: Any) -> Iterator[dict[str, Any]]:
    """Every mapping inside of a layout."""
    if isinstance(of, dict):
        yield of
    for child in of.values() if isinstance(of, dict) else of if isinstance(of, list) else ():
        yield from parts(child)


RVIZ_PARTS = [p for p in parts(RVIZ) if 'Topic' in p]


@pytest.mark.parametrize('part', RVIZ_PARTS, ids=lambda p: p.get('Name', p['Class']))
def test_rviz_shows_topics_of_the_nodes_with_their_types_and_qos(part):
    topic, kind = part['Topic'], part['Class'].split('/')[1]
    assert TYPES[topic['Value']] == TAKES[kind]
    if kind == 'SetInitialPose':
        return
    qos = QOS[topic['Value']]
    assert topic['Durability Policy'] == (
        'Transient Local' if 'transient local' in qos else 'Volatile'
    )
    assert topic['Reliability Policy'] == ('Best Effort' if 'best effort' in qos else 'Reliable')


def test_rviz_shows_all_that_can_be_drawn_and_takes_an_initial_pose():
    kinds = [p['Class'].split('/')[1] for p in parts(RVIZ) if p.get('Class')]
    assert set(TAKES) <= set(kinds)
    shown = {p['Topic']['Value'] for p in RVIZ_PARTS}
    assert {'/map', '/trajectory', '/reflector_map', '/graph', '/pose', '/initialpose'} <= shown


def foxglove_topics() -> list[str]:
    out: list[str] = []
    for name, panel in FOXGLOVE['configById'].items():
        kind = name.split('!')[0]
        if kind == '3D':
            out += [*panel['topics'], panel['publish']['poseEstimateTopic']]
        elif kind == 'Plot':
            out += [p['value'].split('.')[0] for p in panel['paths']]
        elif kind == 'DiagnosticSummary':
            out.append(panel['topicToRender'])
    return out


@pytest.mark.parametrize('topic', foxglove_topics())
def test_foxglove_shows_topics_of_the_nodes(topic):
    assert topic in TYPES


def test_foxglove_shows_what_files_of_live_drives_have():
    pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')
    from rlml_slam.cli.support.live_bag import OTHERS, published

    sensors = {
        name for name, t in zip(NAMES.values(), TOPICS, strict=True) if t.direction == 'sub'
    }
    assert set(foxglove_topics()) <= {*published(), *OTHERS, *sensors}


def test_foxglove_calls_services_of_the_nodes():
    known = {'/' + s.name.replace('~', s.node) for s in SERVICES}
    asked = [p['serviceName'] for p in FOXGLOVE['configById'].values() if 'serviceName' in p]
    assert asked
    assert set(asked) <= known


def test_every_foxglove_panel_has_its_place():
    def places(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from places(node['first'])
            yield from places(node['second'])

    assert sorted(places(FOXGLOVE['layout'])) == sorted(FOXGLOVE['configById'])


@pytest.mark.parametrize(
    'path',
    [
        p['value']
        for n, c in FOXGLOVE['configById'].items()
        if n.startswith('Plot')
        for p in c['paths']
    ],
)
def test_plotted_fields_are_those_of_the_messages(path):
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    topic, *fields = path.split('.')
    package, name = TYPES[topic].split('/')
    kind = f'{package}/msg/{name}'
    for field in fields:
        found = {f: spec for f, spec in types.fielddefs[kind][1]}
        name = field.split('[')[0]
        assert name in found, f'{kind} has no {field}'
        node = found[name][1]
        kind = node if isinstance(node, str) else node[0] if isinstance(node[0], str) else ''


def test_layouts_are_installed(monkeypatch):
    monkeypatch.chdir(ROOT)
    with mock.patch('setuptools.setup') as setup:
        runpy.run_path(str(ROOT / 'setup.py'))
    files = dict(setup.call_args.kwargs['data_files'])['share/rlml_slam/config']
    assert {'rlml_slam.rviz', 'foxglove.json', 'default.yaml'} <= {Path(f).name for f in files}
