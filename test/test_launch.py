# SPDX-License-Identifier: Apache-2.0
"""Launch files and config/nav2.yaml name what there is; launch itself is not needed.

Stand-ins record what a launch file asks for. That `ros2 launch` takes it is not shown here:
launch_ros is not among the wheels.
"""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from rlml_slam.params import NODES, DetectorParameters, Parameters, declarations, from_mapping

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
SETUP = (ROOT / 'setup.py').read_text(encoding='utf-8')
OF = {'slam': Parameters, 'reflector_detector': DetectorParameters}


class Configuration:
    """A LaunchConfiguration whose values are in the context."""

    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context[self.name]


@pytest.fixture
def launched(monkeypatch):
    """Runs a launch file with arguments: the nodes that it starts, and its arguments."""
    made = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': lambda name, **kw: SimpleNamespace(name=name, **kw),
            'OpaqueFunction': lambda function: function,
        },
        'launch.substitutions': {'LaunchConfiguration': Configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': lambda **kw: SimpleNamespace(**kw)},
    }
    for name, content in made.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def launch(path, **given):
        *arguments, start = runpy.run_path(str(path))['generate_launch_description']()
        defaults = {a.name: a.default_value for a in arguments}
        assert given.keys() <= defaults.keys()
        assert all(a.description for a in arguments)
        context = defaults | given
        assert None not in context.values(), 'an argument without default has to be given'
        return start(context)

    return launch


def given_to(node):
    return {k: v for p in node.parameters if isinstance(p, dict) for k, v in p.items()}


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_launch_files_start_what_is_installed_with_parameters_that_exist(path, launched):
    needed = {'map': '/maps/hall.yaml'} if 'localization' in path.name else {}
    nodes = launched(path, detect_reflectors='true', params_file='my.yaml', **needed)
    assert [n.executable for n in nodes] == ['slam', 'reflector_detector']
    for node in nodes:
        assert node.package == 'rlml_slam'
        assert f"'{node.executable}'" in SETUP
        assert node.parameters[0] == 'my.yaml'
        values = given_to(node)
        assert values.pop('use_sim_time') is False
        from_mapping(values, OF[node.executable])  # names, types and choices
    assert len(launched(path, **needed)) == 1


def test_map_is_a_path_as_users_of_nav2_give_it(launched):
    path = ROOT / 'launch' / 'localization.launch.py'
    (node,) = launched(path, map='/robot/maps/hall.1.yaml', use_sim_time='True')
    values = given_to(node)
    assert values['map_directory'] == '/robot/maps'
    assert values['map_file_name'] == 'hall.1.yaml'
    assert values['mode'] == 'localization'
    assert values['use_sim_time'] is True


def test_map_by_its_name_is_where_mapping_saved_it(launched):
    (mapping,) = launched(ROOT / 'launch' / 'mapping.launch.py', map_file_name='warehouse')
    (node,) = launched(ROOT / 'launch' / 'localization.launch.py', map='warehouse')
    for name in ('map_directory', 'map_file_name'):
        assert given_to(node)[name] == given_to(mapping)[name]
    (node,) = launched(ROOT / 'launch' / 'localization.launch.py', map='site.v2')
    assert given_to(node)['map_directory'] == 'maps'
    (node,) = launched(ROOT / 'launch' / 'localization.launch.py', map='maps/warehouse')
    assert given_to(node)['map_directory'] == str(Path('maps').absolute())
    (node,) = launched(ROOT / 'launch' / 'localization.launch.py', map='warehouse.yaml')
    assert given_to(node)['map_directory'] == str(Path.cwd())


def test_launch_files_and_config_are_installed():
    for folder in ('launch', 'config'):
        assert re.search(rf"glob\('{folder}/\*", SETUP)


def test_nav2_config_uses_our_frames_and_no_amcl():
    sections = yaml.safe_load((ROOT / 'config' / 'nav2.yaml').read_text(encoding='utf-8'))
    assert not {'amcl', 'map_server', 'slam_toolbox'} & sections.keys()
    managed = sections['lifecycle_manager_navigation']['ros__parameters']['node_names']
    assert not {'amcl', 'map_server'} & set(managed)
    shared = sections['/**']['ros__parameters']
    assert shared.keys() <= {d.name for of in NODES for d in declarations(of)}
    n = Parameters().node
    timing = sections['back_end']['ros__parameters']
    assert timing == {
        name: getattr(n, name) for name in ('transform_tolerance', 'transform_publish_period')
    }
    frames = (shared['map_frame'], shared['odom_frame'], shared['base_frame'])
    assert frames == (n.map_frame, n.odom_frame, n.base_frame)
    costmap = sections['global_costmap']['global_costmap']['ros__parameters']
    assert costmap['global_frame'] == n.map_frame
    assert costmap['static_layer']['map_subscribe_transient_local'] is True
    local = sections['local_costmap']['local_costmap']['ros__parameters']
    assert local['global_frame'] == n.odom_frame
    assert sections['bt_navigator']['ros__parameters']['odom_topic'] == n.odom_topic
