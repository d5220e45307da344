# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM system with the interface of the RLML replay: inputs in, frames and a map out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ekf.estimator import Estimator
from rlml_slam.estimation.smoother import Smoothed
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.synchronized_system import SynchronizedSystem
from rlml_slam.types import Frame, Observation, Reflectors


class EkfSlam(SynchronizedSystem):
    """Synchronizer and filter; frames are live estimates, the final path is smoothed."""

    def __init__(self, params: EkfParameters) -> None:
        super().__init__(params)
        self.estimator = Estimator(params, params.ekf.smooth)
        self._smoothed: Smoothed | None = None

    def finish(self) -> list[Frame]:
        """Process the remaining inputs, then smooth the path."""
        frames = self.process(self.synchronizer.flush())
        self.estimator.filter.settle()
        self._smoothed = self.estimator.smoothed()
        return frames

    def process(self, observations: Iterable[Observation]) -> list[Frame]:
        """Frames of the synchronized observations."""
        return [self.estimator.process(o) for o in observations]

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) of the likeliest branch, smoothed.

        Before the end, and without ``ekf.smooth``, those estimated live.
        """
        stamps, poses = self.estimator.trajectory()
        return stamps, poses if self._smoothed is None else self._smoothed.states[:, :3].copy()

    def reflectors(self) -> Reflectors:
        """Landmarks with positions and covariances of the smoothed path."""
        found = self.estimator.reflectors()
        if self._smoothed is None:
            return found
        _, at, here = np.intersect1d(found.keys, self._smoothed.keys, return_indices=True)
        points, cov = found.points.copy(), found.cov.copy()
        points[at], cov[at] = self._smoothed.points[here], self._smoothed.covs[here]
        return dataclasses.replace(found, points=points, cov=cov)

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The scans drawn along the trajectory, None without any."""
        return self.estimator.occupancy_grid(self.trajectory())
