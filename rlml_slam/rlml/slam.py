# SPDX-License-Identifier: Apache-2.0
"""The whole system in one object: inputs in, frames and a map out. Replay and tests drive this."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.rlml.back_end import BackEnd, Update
from rlml_slam.rlml.front_end import FrontEnd
from rlml_slam.se2 import Array
from rlml_slam.sensing.sequence import Sequencer
from rlml_slam.types import Detections, Frame, Imu, Observation, Odometry, Reflectors, Scan


class Slam:
    """Sequencer, front end and back end; each ``add_…`` returns the frames that became ready."""

    def __init__(self, params: Parameters) -> None:
        self.sequencer = Sequencer(params)
        self.front_end = FrontEnd(params)
        self.back_end = BackEnd(params)
        self.updates: list[Update] = []

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
        """Everything that still waits; then the last optimisation."""
        frames = self._process(self.sequencer.flush())
        self.back_end.finish()
        return frames

    def _process(self, observations: Iterable[Observation]) -> list[Frame]:
        frames = []
        for observation in observations:
            frame = self.front_end.process(observation)
            update = self.back_end.add(frame)
            if update is not None:
                self.updates.append(update)
                if update.optimized:
                    self.front_end.correct(update.T_map_local)
                    belief = self.back_end.belief()
                    if belief is not None and self.front_end.contradicts(belief):
                        self.front_end.adopt(belief)
            frames.append(frame)
        return frames

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and optimised poses (n, 3), map frame, one per frame."""
        return self.back_end.trajectory()

    def reflectors(self) -> Reflectors:
        """The reflector map."""
        return self.back_end.reflectors()

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The map of the scans, None without any."""
        return self.back_end.occupancy_grid()
