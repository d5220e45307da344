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
from rlml_slam.params.ros_node import Incident, Node, PlayerParameters
from rlml_slam.params.simulator import SimulatorParameters


@dataclass(frozen=True)
class Parameters:
    """Parameters of RLML: fields of ``node`` have plain ROS names, all others ``group.field``."""

    node: Node = field(default_factory=Node)
    motion: MotionNoise = field(default_factory=MotionNoise)
    reflector: Reflector = field(default_factory=Reflector)
    detector: Detector = field(default_factory=Detector)
    submap: Submap = field(default_factory=Submap)
    scan_match: ScanMatch = field(default_factory=ScanMatch)
    health: HealthLimits = field(default_factory=HealthLimits)
    back_end: BackEnd = field(default_factory=BackEnd)
    loop_closure: LoopClosure = field(default_factory=LoopClosure)
    relocalization: Relocalization = field(default_factory=Relocalization)
    solver: Solver = field(default_factory=Solver)
    incident: Incident = field(default_factory=Incident)


@dataclass(frozen=True)
class EkfParameters(Parameters):
    """Parameters of ekf_slam: its own groups, and those that it shares with RLML."""

    ekf: Ekf = field(default_factory=Ekf)
    spikes: Spikes = field(default_factory=Spikes)
    ransac: Ransac = field(default_factory=Ransac)


@dataclass(frozen=True)
class DeformableParameters:
    """Parameters of deformable_slam: its own group, and those that it shares with RLML."""

    node: Node = field(default_factory=Node)
    motion: MotionNoise = field(default_factory=MotionNoise)
    reflector: Reflector = field(default_factory=Reflector)
    deformable: Deformable = field(default_factory=Deformable)


@dataclass(frozen=True)
class DetectorParameters:
    """Parameters of reflector_detector: its own group, and those that it shares with RLML."""

    node: Node = field(default_factory=Node)
    motion: MotionNoise = field(default_factory=MotionNoise)
    detector: Detector = field(default_factory=Detector)


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
