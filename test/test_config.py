# SPDX-License-Identifier: Apache-2.0
"""config/, the parameters, the package description and the executables say the same."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from rlml_lab.support.config_file import FILES, UNREAD, parameter_file
from rlml_lab.support.security_policy import POLICY, policy
from rlml_slam import __version__
from rlml_slam.errors import FileFormatError, ParameterError
from rlml_slam.params import (
    NODES,
    DetectorParameters,
    EkfParameters,
    Parameters,
    SimulatorParameters,
    declarations,
    flatten,
    from_mapping,
    read_yaml,
)

ROOT = Path(__file__).resolve().parents[1]
KNOWN = {d.name for of in NODES for d in declarations(of)}


@pytest.mark.parametrize('name', FILES)
def test_parameter_files_are_what_is_declared(name):
    assert (ROOT / 'config' / name).read_text() == parameter_file(name), 'run `make config`'


def test_policy_has_the_topics_of_the_nodes():
    text = POLICY.read_text(encoding='utf-8')
    assert policy(text) == text, 'run `make config`'
    assert policy(text.replace('<topic>scan</topic>', '<topic>scanned</topic>')) == text


@pytest.mark.parametrize('name', FILES)
def test_parameter_files_give_the_defaults(name):
    of, _ = FILES[name]
    assert from_mapping(read_yaml(ROOT / 'config' / name, of), of) == of()


@pytest.mark.parametrize('path', sorted((ROOT / 'config').glob('*.yaml')), ids=lambda p: p.name)
def test_parameter_files_name_no_unknown_parameter(path):
    assert read_yaml(path).keys() <= KNOWN


@pytest.mark.parametrize('of', NODES)
def test_a_live_change_is_of_one_set_alone(of):
    for d in declarations(of):
        if d.live and isinstance(d.default, float):
            getattr(of(), d.group).change(d.field, d.default + 0.25 * (d.high - d.default) + 0.125)
    for d in declarations(of):
        assert getattr(getattr(of(), d.group), d.field) == d.default


def test_every_parameter_says_what_it_is():
    for of in NODES:
        for d in declarations(of):
            assert len(d.meaning) > 5, d.name
            assert d.low <= d.high, d.name


def test_defaults_lie_inside_their_bounds():
    for of in NODES:
        from_mapping({d.name: d.default for d in declarations(of)}, of)


def test_nested_yaml_is_flattened_as_ros_does():
    assert flatten({'a': {'b': {'c': 1}}, 'd': 2}) == {'a.b.c': 1, 'd': 2}


DETECTOR = {'odom_topic': 'wheels', 'detector.threshold': 'fixed'}
SHARED = """
/**:
  ros__parameters: {use_sim_time: true, odom_topic: wheels, detector.threshold: fixed}
/robot1/front_end:
  ros__parameters: {submap: {insertions: 80}}
back_end: {ros__parameters: {map_file_name: hall, qos_overrides: {/clock: {depth: 1}}}}
simulator:
  ros__parameters: {laser_frame: eye}
controller_server:
  ros__parameters: {use_odom: false, FollowPath: {plugin: dwb}}
local_costmap:
  local_costmap:
    ros__parameters: {resolution: 0.1}
"""


@pytest.mark.parametrize(
    ('of', 'values'),
    [
        (
            Parameters,
            {**DETECTOR, 'submap.insertions': 80, 'map_file_name': 'hall'},
        ),
        (EkfParameters, DETECTOR),
        (DetectorParameters, DETECTOR),
        (SimulatorParameters, {'laser_frame': 'eye'}),
    ],
)
def test_one_file_may_serve_all_nodes_of_a_robot(of, values, tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text(SHARED)
    assert read_yaml(path, of) == values


@pytest.mark.parametrize(
    ('text', 'why'),
    [
        ('controller_server: {ros__parameters: {use_odom: false}}', 'no section for front_end or'),
        ('use_odom: false', "'use_odom' has no ros__parameters"),
        ('[1, 2]', 'no parameters in this file'),
        ('a: [', 'not YAML'),
    ],
)
def test_file_without_parameters_of_the_nodes_is_refused(text, why, tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text(text)
    with pytest.raises(FileFormatError, match=why):
        read_yaml(path)


@pytest.mark.parametrize('of', NODES)
def test_error_names_the_parameter_of_a_wrong_value(of):
    for d in declarations(of):
        with pytest.raises(ParameterError, match=f'^{re.escape(d.name)} = None is '):
            from_mapping({d.name: None}, of)


def test_misspelt_parameter_is_refused(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text('front_end: {ros__parameters: {use_odon: false}}')
    with pytest.raises(ParameterError, match="unknown parameter 'use_odon'; similar: use_odom"):
        from_mapping(read_yaml(path))


@pytest.mark.parametrize(
    ('name', 'value', 'why'),
    [
        ('map_start_pose', [1.0], r'map_start_pose = \[1.0\] is not a list of 3 numbers'),
        ('laser_pose', [], 'is not a list of 3 numbers'),
        ('laser_pose', [0.0, 0.0, 0.0, 0.0], 'is not a list of 3 numbers'),
        ('submap.bias_variance', [-1.0, 0.0, 0.0], r'has a number outside \[0, 100\]'),
        ('loop_closure.variance_floor', [0.0, 0.0, -1e-9], r'has a number outside \[0, 100\]'),
        ('back_end.match_sigma', [0.0, 0.1, 0.1], r'has a number outside \[0.0001, 10\]'),
        ('laser_pose', [0.0, 0.0, 10**400], 'is not a list of finite numbers'),
        ('odom_timeout', 10**400, 'is not a finite number'),
    ],
)
def test_numbers_are_checked_for_length_and_range(name, value, why):
    with pytest.raises(ParameterError, match=why):
        from_mapping({name: value})


@pytest.mark.parametrize('of', NODES)
def test_names_of_frames_lose_the_slash_that_ros_1_allowed(of):
    for d in declarations(of):
        if d.name.endswith('_frame') and isinstance(d.default, str):
            group = getattr(from_mapping({d.name: f'/{d.default}'}, of), d.group)
            assert getattr(group, d.field) == d.default


@pytest.mark.parametrize('name', ['', '/'])
def test_frame_without_a_name_is_refused(name):
    with pytest.raises(ParameterError, match=rf"base_frame = '{name}' is no name of a frame"):
        from_mapping({'base_frame': name})


def test_whole_number_that_python_does_not_print_is_refused_by_its_name():
    with pytest.raises(ParameterError, match='odom_timeout = a number that is too long to print'):
        from_mapping({'odom_timeout': 1 << 20000})


def test_versions_agree():
    described = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('version')
    assert described == __version__
    assert 'package.xml' in (ROOT / 'setup.py').read_text()  # where it reads what it installs


def test_people_and_addresses_are_written_once():
    about = ElementTree.parse(ROOT / 'package.xml').getroot()
    people = [p.get('email') for p in about.findall('maintainer')]
    assert people
    assert {u.get('type') for u in about.findall('url')} == {'website', 'repository', 'bugtracker'}
    for file in ('setup.py', 'README.md', 'QUALITY_DECLARATION.md', 'CONTRIBUTING.md'):
        text = (ROOT / file).read_text(encoding='utf-8')
        assert not [address for address in people if address in text], file


def test_every_executable_exists_and_every_node_is_one():
    (names,) = re.findall(r'^NODES = \((.*?)\)', (ROOT / 'setup.py').read_text(), re.M | re.S)
    executables = set(re.findall(r"'(\w+)'", names))
    nodes = {p.stem for p in (ROOT / 'rlml_slam/nodes').glob('*.py')} - {'__init__'}
    assert executables == nodes
    for name in executables:
        assert 'def main()' in (ROOT / f'rlml_slam/nodes/{name}.py').read_text()


@pytest.mark.parametrize('drive', ['room', 'hall'])
def test_every_kernel_is_compiled_ahead(drive):
    """After the warm-up, a drive with closures asks for no kernel that is not there yet."""
    code = """
import sys
from rlml_slam import warm_up
from rlml_slam.compiled import LIBRARY
from rlml_slam.kernels import native
from rlml_slam.params import Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.ros.bags.bag import BagReader, choose_topics
from rlml_slam.ros.sensor_input import SensorInput

def compiled():
    if LIBRARY is not None:
        assert 'numba' not in sys.modules
        return set(native.CONVERTED)
    from numba.core.dispatcher import Dispatcher
    return {
        f'{value.__module__}.{value.__name__}{signature}'
        for name, module in list(sys.modules.items()) if name.startswith('rlml_slam.')
        for value in vars(module).values() if isinstance(value, Dispatcher)
        for signature in value.signatures
    }

warm_up.compile_loaded()
before = compiled()
params = Parameters()
slam = Slam(params)
feed = SensorInput(params, slam, slam.synchronizer.inputs)
with BagReader(sys.argv[1]) as bag:
    stream_of = {topic: s for s, topic in choose_topics(bag.topics, params.node).items()}
    for time, topic, message in bag.messages(stream_of):
        feed.add(stream_of[topic], message)
slam.finish()
slam.occupancy_grid(), slam.reflectors(), slam.trajectory()
assert any(c.accepted for c in slam.back_end.loop_closer.records)
print('late:', *sorted(compiled() - before))
"""
    done = subprocess.run(
        [sys.executable, '-c', code, f'bags/{drive}'],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == 'late:'


@pytest.mark.parametrize('kind', ['', 'colcon-'])
def test_every_supported_python_has_pinned_requirements(kind):
    for minor in range(10, 14):
        lock = ROOT / 'requirements' / f'{kind}python3.{minor}.txt'
        lines = [line for line in lock.read_text().splitlines() if not line.startswith('#')]
        assert lines
        assert all(re.fullmatch(r'[a-z0-9-]+==[\w.+]+', line) for line in lines), lock


def test_pinned_requirements_hold_all_that_is_asked_for():
    def names(path):
        lines = (line for line in path.read_text().splitlines() if not line.startswith('#'))
        return {re.split(r'[\[<=]', line)[0] for line in lines}

    asked = names(ROOT / 'requirements/top.in')
    (needed,) = re.findall(r'install_requires=\[(.*?)\]', (ROOT / 'setup.py').read_text(), re.S)
    assert set(re.findall(r"'([\w-]+)'", needed)) <= asked
    for minor in range(10, 14):
        assert asked <= names(ROOT / f'requirements/python3.{minor}.txt')


def test_this_python_is_supported():
    assert (3, 10) <= sys.version_info[:2] <= (3, 13)


def test_parameter_files_leave_out_what_their_node_does_not_read():
    for name, unread in UNREAD.items():
        of, _ = FILES[name]
        names = {d.name for d in declarations(of)}
        listed = read_yaml(ROOT / 'config' / name, of).keys()
        # whole groups, or single names
        assert set(unread) <= names | {n.split('.')[0] for n in names}
        expected = {n for n in names if n in unread or n.split('.')[0] in unread}
        assert names - listed == expected
