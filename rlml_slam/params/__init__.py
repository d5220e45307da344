# SPDX-License-Identifier: Apache-2.0
"""All parameters, each declared once: default, unit, bounds and meaning.

A group (``MotionNoise``, ``ScanMatch``, …) is a frozen dataclass; a set (``Parameters``,
``EkfParameters``, …) has the groups of a system. The declaration of ROS parameters
(``ros/declare.py``), ``config/*.yaml`` and the tables of docs/ are derived from these files and
tested against them.
"""

from rlml_slam.params.back_end import BackEnd, LoopClosure, Relocalization, Solver
from rlml_slam.params.declaration import Declaration, Group, changed, declarations, param
from rlml_slam.params.deformable import Deformable
from rlml_slam.params.detector import Detector
from rlml_slam.params.ekf import Ekf, Ransac, Spikes
from rlml_slam.params.files import flatten, from_mapping, read_yaml
from rlml_slam.params.front_end import HealthLimits, MotionNoise, Reflector, ScanMatch, Submap
from rlml_slam.params.ros_node import Node, Player, PlayerParameters
from rlml_slam.params.simulator import (
    Gyro,
    Laser,
    Markers,
    Simulator,
    SimulatorParameters,
    Transport,
    Wheels,
)
from rlml_slam.params.systems import (
    NODES,
    ROS_OWN,
    DeformableParameters,
    DetectorParameters,
    EkfParameters,
    Parameters,
)

__all__ = [
    'NODES',
    'ROS_OWN',
    'BackEnd',
    'Declaration',
    'Deformable',
    'DeformableParameters',
    'Detector',
    'DetectorParameters',
    'Ekf',
    'EkfParameters',
    'Group',
    'Gyro',
    'HealthLimits',
    'Laser',
    'LoopClosure',
    'Markers',
    'MotionNoise',
    'Node',
    'Parameters',
    'Player',
    'PlayerParameters',
    'Ransac',
    'Reflector',
    'Relocalization',
    'ScanMatch',
    'Simulator',
    'SimulatorParameters',
    'Solver',
    'Spikes',
    'Submap',
    'Transport',
    'Wheels',
    'changed',
    'declarations',
    'flatten',
    'from_mapping',
    'param',
    'read_yaml',
]
