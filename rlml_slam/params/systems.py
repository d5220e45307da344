# SPDX-License-Identifier: Apache-2.0
"""The groups that each system has, and the nodes that each is for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rlml_slam.params.back_end import BackEnd, LoopClosure, Relocalization, Solver
from rlml_slam.params.deformable import Deformable
from rlml_slam.params.detector import Detector
from rlml_slam.params.ekf import Ekf, Ransac, Spikes
from rlml_slam.params.front_end import HealthLimits, MotionNoise, Reflector, ScanMatch, Submap
from rlml_slam.params.ros_node import Node, PlayerParameters
from rlml_slam.params.simulator import SimulatorParameters


@dataclass(frozen=True)
class Parameters:
    """Parameters of RLML: fields of ``node`` have plain ROS names, all others ``group.field``."""

    node: Node = field(default=Node())
    motion: MotionNoise = field(default=MotionNoise())
    reflector: Reflector = field(default=Reflector())
    detector: Detector = field(default=Detector())
    submap: Submap = field(default=Submap())
    scan_match: ScanMatch = field(default=ScanMatch())
    health: HealthLimits = field(default=HealthLimits())
    back_end: BackEnd = field(default=BackEnd())
    loop_closure: LoopClosure = field(default=LoopClosure())
    relocalization: Relocalization = field(default=Relocalization())
    solver: Solver = field(default=Solver())


@dataclass(frozen=True)
class EkfParameters(Parameters):
    """Parameters of ekf_slam: its own groups, and those that it shares with RLML."""

    ekf: Ekf = field(default=Ekf())
    spikes: Spikes = field(default=Spikes())
    ransac: Ransac = field(default=Ransac())


@dataclass(frozen=True)
class DeformableParameters:
    """Parameters of deformable_slam: its own group, and those that it shares with RLML."""

    node: Node = field(default=Node())
    motion: MotionNoise = field(default=MotionNoise())
    reflector: Reflector = field(default=Reflector())
    deformable: Deformable = field(default=Deformable())


@dataclass(frozen=True)
class DetectorParameters:
    """Parameters of reflector_detector: its own group, and those that it shares with RLML."""

    node: Node = field(default=Node())
    motion: MotionNoise = field(default=MotionNoise())
    detector: Detector = field(default=Detector())


# names of the nodes that read each set
NODES: Mapping[type[Any], tuple[str, ...]] = {
    Parameters: ('front_end', 'back_end'),
    EkfParameters: ('ekf_slam',),
    DeformableParameters: ('deformable_slam',),
    DetectorParameters: ('reflector_detector',),
    SimulatorParameters: ('simulator',),
    PlayerParameters: ('bag_player',),
}
# parameters that ROS gives to every node
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
