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
from rlml_slam.sensing.driven import Driven
from rlml_slam.types import Frame, Observation, Reflectors


class EkfSlam(Driven):
    """Sequencer and filter."""

    def __init__(self, params: EkfParameters) -> None:
        super().__init__(params)
        self.estimator = Estimator(params)

    def finish(self) -> list[Frame]:
        """Everything that still waits."""
        frames = self.process(self.sequencer.flush())
        self.estimator.filter.settle()
        return frames

    def process(self, observations: Iterable[Observation]) -> list[Frame]:
        """What the sequencer made of the inputs."""
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
