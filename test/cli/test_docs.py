# SPDX-License-Identifier: Apache-2.0
"""The tables of docs are those of the code, and the code is what the nodes do."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rlml_slam.cli.docs import TABLES, filled, parameter_table
from rlml_slam.cli.main import main
from rlml_slam.cli.support.interface import SERVICES, TOPICS
from rlml_slam.errors import FileFormatError
from rlml_slam.params import Parameters, SimulatorParameters, declarations

NODES = (
    'front_end', 'back_end', 'simulator', 'deformable_slam',
    'reflector_detector',
)  # fmt: skip
ROOT = Path(__file__).resolve().parents[2]
TABLED = (ROOT / 'docs' / 'topics.md', ROOT / 'docs' / 'parameters.md')
# what every node of rclpy has
OF_EVERY_NODE = {'/rosout', '/parameter_events'}


def test_docs_are_up_to_date():
    texts = {path: path.read_text(encoding='utf-8') for path in TABLED}
    wanted = f'run: rlml docs --write {" ".join(str(p.relative_to(ROOT)) for p in TABLED)}'
    assert filled(texts) == texts, wanted
    contributing = (ROOT / 'CONTRIBUTING.md').read_text(encoding='utf-8')
    assert wanted.removeprefix('run: ') in contributing


@pytest.mark.parametrize('of', [Parameters, SimulatorParameters])
def test_every_parameter_has_its_row(of):
    rows = parameter_table(of).splitlines()[2:]
    assert [row.split('`')[1] for row in rows] == [d.name for d in declarations(of)]


def test_tables_are_put_between_the_marks(tmp_path, capsys):
    marks = [f'<!-- begin {t} -->\nold {t}\n<!-- end {t} -->\n' for t in TABLES]
    paths = [tmp_path / 'one.md', tmp_path / 'other.md']
    for path, part in zip(paths, (marks[:2], marks[2:]), strict=True):
        path.write_text('# Title\n' + 'text\n'.join(part) + 'the end\n')
    assert main(['docs', '--write', *map(str, paths)]) == 0
    texts = {path: path.read_text() for path in paths}
    for text in texts.values():
        assert text.startswith('# Title\n')
        assert text.endswith('the end\n')
        assert '\nold ' not in text
    assert filled(texts) == texts
    assert main(['docs']) == 0
    printed = capsys.readouterr().out
    assert all(make() in ''.join(texts.values()) and make() in printed for make in TABLES.values())


@pytest.mark.parametrize('times', [0, 2])
def test_marks_that_are_not_there_once_are_named(times):
    marks = '<!-- begin topics --><!-- end topics -->'
    others = {Path('other.md'): marks}
    texts = {Path('topics.md'): marks, **others} if times else {Path('topics.md'): ''}
    with pytest.raises(
        FileFormatError, match=r'topics.md.*: <!-- begin topics --> … .* not there exactly once'
    ):
        filled(texts)


@pytest.fixture(scope='module')
def nodes():
    """All nodes in this process, with every optional topic switched on."""
    rclpy = pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')
    from rclpy.parameter import Parameter

    from rlml_slam.nodes.back_end import BackEndNode
    from rlml_slam.nodes.deformable_slam import DeformableSlamNode
    from rlml_slam.nodes.front_end import FrontEndNode
    from rlml_slam.nodes.reflector_detector import ReflectorDetectorNode
    from rlml_slam.nodes.simulator import SimulatorNode

    before = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=10 + os.getpid() % 90)
    drive = [Parameter('drive', value='cmd_vel')]
    suggest = [Parameter('deformable.suggest', value='differential')]
    made = [
        FrontEndNode(context=context),
        BackEndNode(context=context),
        SimulatorNode(context=context, parameter_overrides=drive),
        DeformableSlamNode(context=context, parameter_overrides=suggest),
        ReflectorDetectorNode(context=context),
    ]
    yield {node.get_name(): node for node in made}
    for node in made:
        node.destroy_node()
    context.try_shutdown()
    if before is None:
        del os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']
    else:
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = before


def has_tf():
    from rlml_slam.ros.codecs.message_types import rclpy_class
    from rlml_slam.ros.tf import TF_MESSAGE

    return rclpy_class(TF_MESSAGE) is not None


def quality(info):
    profile = info.qos_profile
    words = [profile.reliability.name.lower().replace('_', ' ')]
    if profile.durability.name == 'TRANSIENT_LOCAL':
        words.append('transient local')
    return ', '.join(words)


@pytest.mark.parametrize('name', NODES)
@pytest.mark.parametrize('direction', ['pub', 'sub'])
def test_topics_are_those_of_the_node(nodes, name, direction):
    node = nodes[name]
    of_node, of_topic = {
        'pub': (node.get_publisher_names_and_types_by_node, node.get_publishers_info_by_topic),
        'sub': (node.get_subscriber_names_and_types_by_node, node.get_subscriptions_info_by_topic),
    }[direction]
    found = {
        (topic, kinds[0].replace('/msg/', '/'), quality(info))
        for topic, kinds in of_node(name, '/')
        for info in of_topic(topic)
        if info.node_name == name
        and topic not in OF_EVERY_NODE
        and not kinds[0].startswith('lifecycle_msgs')
    }
    documented = {
        ('/' + t.name.replace('~', name).lstrip('/'), t.type, t.qos)
        for t in TOPICS
        if (t.node, t.direction) == (name, direction)
    }
    if not has_tf():  # the same transforms go elsewhere, or nowhere
        documented = {t for t in documented if not t[0].startswith('/tf')}
        found = {t for t in found if not t[0].endswith('map_to_odom')}
    assert found == documented


@pytest.mark.parametrize('name', NODES)
def test_services_are_those_of_the_node(nodes, name):
    found = {
        (service, kinds[0].replace('/srv/', '/'))
        for service, kinds in nodes[name].get_service_names_and_types_by_node(name, '/')
        if not kinds[0].startswith(
            ('rcl_interfaces', 'type_description_interfaces', 'lifecycle_msgs')
        )
    }
    documented = {
        ('/' + s.name.replace('~', name).lstrip('/'), s.type) for s in SERVICES if s.node == name
    }
    assert found == documented


def test_topics_of_parameters_have_their_names():
    defaults = {d.name: d.default for d in declarations(Parameters)}
    for t in TOPICS:
        if t.parameter:
            assert defaults[t.parameter] == t.name
