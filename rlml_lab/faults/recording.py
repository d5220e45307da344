# SPDX-License-Identifier: Apache-2.0
"""A recording as core values: a bag, or a simulated drive, that faults can be put into."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rlml_lab.support.drives import simulate
from rlml_slam.datasets.tum import Trajectory, read_tum
from rlml_slam.errors import InputError
from rlml_slam.evaluation.relations import Relations, read_relations
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.simulation.simulation import GroundTruth
from rlml_slam.simulation.world_file import world_names
from rlml_slam.types import Detections, Imu, Odometry, Scan

Message = Odometry | Imu | Scan | Detections


@dataclass(frozen=True)
class Recording:
    """Messages in order of arrival, the sensors' places (3,), and what is known to be true.

    ``relations`` compare pairs of poses, ``truth`` has poses; either may be None.
    """

    name: str
    messages: list[Message]
    sensors: dict[str, Array] = field(default_factory=dict)
    relations: Relations | None = None
    truth: Trajectory | None = None

    @property
    def start(self) -> int:
        """Smallest stamp [ns]."""
        return min(m.stamp for m in self.messages)

    @property
    def end(self) -> int:
        """Largest stamp [ns]."""
        return max(m.stamp for m in self.messages)

    def having(self, messages: list[Message]) -> Recording:
        """The same with other messages."""
        return replace(self, messages=messages)


class _Collector:
    """A target of SensorInput that keeps everything."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.sensors: dict[str, Array] = {}

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        self.sensors[frame_id] = T_base_sensor

    def _keep(self, message: Message) -> list[Message]:
        self.messages.append(message)
        return []

    add_odometry = add_transform = add_imu = add_scan = add_detections = _keep


def load(name: str, reference: Path | None, params: Parameters, seed: int = 0) -> Recording:
    """A bag with its reference, or the name of a simulated world.

    A ``reference`` whose name ends in ``.relations`` has relations, any other is a TUM file.
    Without one, the ground truth of the bag is used, if it has any.
    """
    if name in world_names() or name.endswith(('.yaml', '.yml')):
        return simulated(name, seed)
    with BagReader(name) as bag:
        inputs, out = BagInputs(bag, params), _Collector()
        feed = SensorInput(params, out, InputCounts())
        feed.use_extrinsics(inputs.extrinsics)
        for _, stream, message in inputs:
            feed.add(stream, message)
        own = inputs.truth()
    if not out.messages:
        raise InputError(f'{name}: no message that could be used')
    truth = None if own is None or not own.is_map else own.trajectory
    relations = None
    if reference is not None and '.relations' in reference.suffixes:
        relations = read_relations(reference)
    elif reference is not None:
        truth = read_tum(reference)
    return Recording(Path(name).resolve().name, out.messages, out.sensors, relations, truth)


def simulated(world: str, seed: int, simulator: SimulatorParameters | None = None) -> Recording:
    """A simulated drive with its ground truth."""
    p = simulator or SimulatorParameters()
    p = replace(p, node=replace(p.node, world=world))
    messages, truth = simulate(p, seed)
    return Recording(
        f'{Path(world).stem}, seed {seed}',
        [m for m in messages if not isinstance(m, GroundTruth)],
        {p.node.laser_frame: np.array(p.node.laser_pose)},
        truth=truth.trajectory,
    )
