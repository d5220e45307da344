# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM in one object, with the interface of rlml/slam.py: inputs in, frames and a map out."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ekf.estimator import Estimator
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.sequence import Sequencer
from rlml_slam.types import Detections, Frame, Imu, Observation, Odometry, Reflectors, Scan


class EkfSlam:
    """Sequencer and filter; each ``add_…`` returns the frames that became ready."""

    def __init__(self, params: EkfParameters) -> None:
        self.sequencer = Sequencer(params)
        self.estimator = Estimator(params)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """What became of the inputs, by stream."""
        return self.sequencer.inputs.totals()

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Where a sensor sits on the robot (3,)."""
        self.sequencer.set_sensor_pose(frame_id, T_base_sensor)

    def add_odometry(self, sample: Odometry) -> list[Frame]:
        """One wheel odometry sample."""
        return self._process(self.sequencer.add_odometry(sample))

    def add_imu(self, sample: Imu) -> list[Frame]:
        """One IMU sample."""
        return self._process(self.sequencer.add_imu(sample))

    def add_scan(self, scan: Scan) -> list[Frame]:
        """One sweep of the laser."""
        return self._process(self.sequencer.add_scan(scan))

    def add_detections(self, detections: Detections) -> list[Frame]:
        """The reflectors seen at one instant."""
        return self._process(self.sequencer.add_detections(detections))

    def finish(self) -> list[Frame]:
        """Everything that still waits."""
        frames = self._process(self.sequencer.flush())
        self.estimator.filter.settle()
        return frames

    def _process(self, observations: Iterable[Observation]) -> list[Frame]:
        return [self.estimator.process(o) for o in observations]

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) of the likeliest branch, as they were estimated live."""
        return self.estimator.trajectory()

    def reflectors(self) -> Reflectors:
        """The landmarks of the state."""
        return self.estimator.reflectors()

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The scans drawn at the poses of their time, None without any."""
        return self.estimator.occupancy_grid()
