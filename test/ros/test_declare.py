# SPDX-License-Identifier: Apache-2.0
"""Declared parameters and ROS parameters are the same thing."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2 (rclpy)')

from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from rlml_slam.errors import ParameterError  # noqa: E402
from rlml_slam.params import NODES, Parameters, declarations  # noqa: E402
from rlml_slam.ros.declare import declare, pace  # noqa: E402


@pytest.fixture
def make_node(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=10 + os.getpid() % 90)
    nodes = []

    def make(**given):
        overrides = [Parameter(n.replace('__', '.'), value=v) for n, v in given.items()]
        nodes.append(Node('declaring', context=context, parameter_overrides=overrides))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def warnings_of(node, monkeypatch):
    said = []
    logger = SimpleNamespace(warning=said.append)
    monkeypatch.setattr(node, 'get_logger', lambda: logger)
    return said


@pytest.mark.parametrize('of', NODES, ids=lambda of: of.__name__)
def test_every_parameter_is_declared_with_its_default_and_documented(make_node, of):
    node = make_node()
    assert declare(node, of) == of()
    for d in declarations(of):
        value = node.get_parameter(d.name).value
        assert (tuple(value) if isinstance(d.default, tuple) else value) == d.default
        described = node.describe_parameter(d.name)
        assert d.meaning in described.description
        assert d.unit in described.description
        assert ('read when the node starts' in described.additional_constraints) != d.live


def test_ranges_and_choices_are_described(make_node):
    node = make_node()
    declare(node)
    bounds = node.describe_parameter('submap.resolution').floating_point_range[0]
    assert (bounds.from_value, bounds.to_value) == (0.01, 1.0)
    whole = node.describe_parameter('submap.insertions').integer_range[0]
    assert (whole.from_value, whole.to_value) == (2, 10000)
    assert node.describe_parameter('mode').additional_constraints == (
        'one of mapping, localization; read when the node starts'
    )


def test_given_values_are_taken_and_whole_numbers_serve_as_fractions(make_node):
    node = make_node(reflector__max_range=25, use_imu=False, map_start_pose=[1, 2, 3])
    parameters = declare(node)
    assert parameters.reflector.max_range == 25.0
    assert parameters.node.use_imu is False
    assert node.get_parameter('reflector.max_range').value == 25.0
    assert parameters.node.map_start_pose == (1.0, 2.0, 3.0)


@pytest.mark.parametrize('word', ['on', 'off'])
def test_words_that_yaml_takes_for_booleans_are_words(make_node, word):
    node = make_node(detect_reflectors=word == 'on')  # as rcl reads `-p detect_reflectors:=off`
    assert declare(node).node.detect_reflectors == word
    assert node.get_parameter('detect_reflectors').value == word


def test_parameters_that_were_dumped_are_loaded(make_node):
    node = make_node()
    declare(node)
    known = [node.get_parameter(d.name) for d in declarations(Parameters)]
    dumped = [Parameter.from_parameter_msg(p.to_parameter_msg()) for p in known]  # over the wire
    assert all(result.successful for result in node.set_parameters(dumped))
    other = Parameter('odom_frame', value='other')
    assert not node.set_parameters_atomically([*dumped, other]).successful


def test_wrong_value_is_reported_with_its_name_and_meaning(make_node):
    with pytest.raises(
        ParameterError, match=r"^mode = 'mopping' is not one of .*\(build a map, or"
    ):
        declare(make_node(mode='mopping'))


def test_unknown_name_is_warned_about_with_what_may_be_meant(make_node, monkeypatch):
    node = make_node(scan_topik='x')
    said = warnings_of(node, monkeypatch)
    declare(node)
    assert said == ["unknown parameter 'scan_topik' has no effect; is 'scan_topic' meant?"]
    node, said[:] = make_node(nosuchparam=3), []
    said = warnings_of(node, monkeypatch)
    declare(node)
    assert said == [
        "unknown parameter 'nosuchparam' has no effect; --help lists those that have one"
    ]


def test_names_of_the_other_nodes_and_of_rclpy_are_no_mistakes(make_node, monkeypatch):
    node = make_node(wheels__rate=20.0, use_sim_time=True)
    said = warnings_of(node, monkeypatch)
    assert declare(node) == Parameters()
    assert said == []


def test_live_parameters_change_and_others_say_why_not(make_node):
    node, taken = make_node(), []

    def check(name):
        if name == 'bad':
            raise ParameterError('bad is no name')
        taken.append(name)

    parameters = declare(node, checks={'map_file_name': check})
    limits = parameters.health

    def given(**values):
        new = [Parameter(n.replace('__', '.'), value=v) for n, v in values.items()]
        return node.set_parameters_atomically(new)

    assert given(health__sigma_lost=1.0, map_file_name='second').successful
    assert limits.sigma_lost == 1.0
    assert (parameters.node.map_file_name, taken) == ('second', ['second'])
    for values, why in (
        ({'mode': 'localization'}, 'mode is read when the node starts: restart it'),
        ({'health.sigma_lost': -1.0}, 'out of range'),
        ({'health.sigma_lost': 'much'}, ''),
        ({'map_file_name': 'bad'}, 'bad is no name'),
    ):
        answer = given(**values)
        assert not answer.successful
        assert why in answer.reason
    assert (limits.sigma_lost, parameters.node.map_file_name) == (1.0, 'second')
    assert not given(health__sigma_degraded=0.1, use_imu=False).successful
    assert limits.sigma_degraded == Parameters().health.sigma_degraded


def test_timer_is_changed_by_a_set_that_is_taken_and_never_without_a_pause(make_node):
    node, timer = make_node(), SimpleNamespace(timer_period_ns=20_000_000)

    def refuse(name):
        raise ParameterError(name)

    declare(node, checks={'transform_publish_period': pace(timer), 'map_file_name': refuse})

    def given(period, **others):
        values = {'transform_publish_period': period, **others}
        return node.set_parameters_atomically([Parameter(n, value=v) for n, v in values.items()])

    assert not given(1.0, use_imu=False).successful
    assert not given(1.0, map_file_name='other').successful
    assert timer.timer_period_ns == 20_000_000
    for period, ns in ((0.5, 500_000_000), (1e-10, 1_000_000), (0.0, 100_000_000)):
        assert given(period).successful
        assert timer.timer_period_ns == ns


def test_frames_lose_the_slash_that_ros_1_allowed(make_node):
    node = make_node(base_frame='/base_link', scan_topic='/scan')
    parameters = declare(node)
    assert (parameters.node.base_frame, parameters.node.scan_topic) == ('base_link', '/scan')
    assert node.get_parameter('base_frame').value == 'base_link'
