# SPDX-License-Identifier: Apache-2.0
"""What every system that is driven by sensors has in common: inputs in, frames out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.types import Detections, Frame, Imu, Observation, Odometry, Scan


class SynchronizedSystem(ABC):
    """A sequencer before a system; each ``add_…`` returns the frames that became ready."""

    def __init__(self, params: Parameters) -> None:
        self.synchronizer = Synchronizer(params)

    @abstractmethod
    def process(self, observations: Iterable[Observation]) -> list[Frame]:
        """What the sequencer made of the inputs."""

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """What became of the inputs, by stream."""
        return self.synchronizer.inputs.totals()

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Where a sensor sits on the robot (3,)."""
        self.synchronizer.set_sensor_pose(frame_id, T_base_sensor)

    def add_odometry(self, sample: Odometry) -> list[Frame]:
        """One wheel odometry sample."""
        return self.process(self.synchronizer.add_odometry(sample))

    def add_transform(self, sample: Odometry) -> list[Frame]:
        """The pose of base in odom as it is on /tf."""
        return self.process(self.synchronizer.add_transform(sample))

    def add_imu(self, sample: Imu) -> list[Frame]:
        """One IMU sample."""
        return self.process(self.synchronizer.add_imu(sample))

    def add_scan(self, scan: Scan) -> list[Frame]:
        """One sweep of the laser."""
        return self.process(self.synchronizer.add_scan(scan))

    def add_detections(self, detections: Detections) -> list[Frame]:
        """The reflectors seen at one instant."""
        return self.process(self.synchronizer.add_detections(detections))
