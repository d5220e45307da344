# SPDX-License-Identifier: Apache-2.0
"""Map: front end and back end in one process, and the reflector detector where it is wanted.

ros2 launch rlml_slam mapping.launch.py params_file:=my.yaml detect_reflectors:=true
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    'params_file': ('', 'parameter file, such as a copy of config/default.yaml'),
    'use_sim_time': ('false', 'time of /clock, for simulators and bags'),
    'namespace': ('', 'of all nodes, where there are several robots'),
    'map_directory': ('maps', 'folder that maps are saved to'),
    'map_file_name': ('map', 'name under which save_map writes'),
    'detect_reflectors': ('false', 'detect reflectors in the intensities of scans'),
}


def nodes(context):
    """The nodes, with the arguments as they were given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    files = [given['params_file']] if given['params_file'] else []
    sim_time = {'use_sim_time': given['use_sim_time'].lower() == 'true'}
    common = {'package': 'rlml_slam', 'namespace': given['namespace'], 'output': 'screen'}
    own = {
        'mode': 'mapping',
        'map_directory': given['map_directory'],
        'map_file_name': given['map_file_name'],
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
