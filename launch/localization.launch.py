# SPDX-License-Identifier: Apache-2.0
"""Localize in a saved map, or in a map of nav2, in the place of AMCL and map_server.

ros2 launch rlml_slam localization.launch.py map:=$HOME/maps/warehouse.yaml
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    'map': (
        None,
        'the map: a .rlml file, a .yaml file of nav2, or the path without suffix; '
        'a name without folder and suffix is one of map_directory',
    ),
    'map_directory': ('maps', 'folder of a map that is given by its name'),
    'params_file': ('', 'parameter file, such as a copy of config/default.yaml'),
    'use_sim_time': ('false', 'time of /clock, for simulators and bags'),
    'namespace': ('', 'of all nodes, where there are several robots'),
    'detect_reflectors': ('false', 'detect reflectors in the intensities of scans'),
}


def nodes(context):
    """The nodes, with the arguments as they were given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    files = [given['params_file']] if given['params_file'] else []
    sim_time = {'use_sim_time': given['use_sim_time'].lower() == 'true'}
    common = {'package': 'rlml_slam', 'namespace': given['namespace'], 'output': 'screen'}
    file = Path(given['map']).expanduser()
    is_name = '/' not in given['map'] and file.suffix not in ('.rlml', '.yaml', '.csv')
    folder = given['map_directory'] if is_name else str(file.absolute().parent)
    own = {
        'mode': 'localization',
        'map_directory': folder,
        'map_file_name': file.name,
    }
    out = [Node(executable='slam', parameters=[*files, sim_time, own], **common)]
    if given['detect_reflectors'].lower() == 'true':
        out.append(Node(executable='reflector_detector', parameters=[*files, sim_time], **common))
    return out


def generate_launch_description():
    """What `ros2 launch` asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=meaning)
        for name, (value, meaning) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])
