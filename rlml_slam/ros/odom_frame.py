# SPDX-License-Identifier: Apache-2.0
"""Pose of the odometry frame in the map, for /tf."""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.types import Frame


class OdomFrame:
    """Follows the frames; ``newest`` is the stamp [ns] of the last one and T_map_odom (3,).

    It is None before the first frame with odometry. With the odometry of the frame, which is that
    on /tf where it is there, it gives the pose in the map that the front end published.
    """

    def __init__(self) -> None:
        self.newest: tuple[int, Array] | None = None
        self.T_odom_base = np.zeros(3)  # of the newest frame that has it
        self._has_odometry = False  # in any session: odom is the robot's, not the front end's

    def restart(self) -> None:
        """The local frame is another one from now on."""
        self.newest = None

    def follow(self, frame: Frame) -> None:
        """Take the next frame; one without the odometry there is leaves odom where it was."""
        T_odom_base = frame.observation.odom_pose
        if T_odom_base is not None:
            self._has_odometry = True
        elif self._has_odometry:
            if self.newest is not None:
                self.newest = (frame.stamp, self.newest[1])
            return
        else:  # without any odometry, odom is the local frame
            T_odom_base = frame.T_local_base
        self.T_odom_base = T_odom_base
        T_map_odom = se2.compose(frame.T_map_base, se2.inverse(T_odom_base))
        self.newest = (frame.stamp, T_map_odom)
