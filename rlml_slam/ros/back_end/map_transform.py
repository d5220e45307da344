# SPDX-License-Identifier: Apache-2.0
"""Map to odom on /tf: exact at every scan, and dated ahead until the next one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Node
from rlml_slam.ros.tf import TransformPublisher
from rlml_slam.se2 import Array
from rlml_slam.types import Frame

# stamp [ns], T_map_odom and T_odom_base -> what is to be published of T_map_odom
Smoothing: TypeAlias = Callable[[int, Array, Array], Array]
SECOND = 1_000_000_000
SILENT = SECOND  # [ns] after a frame, from which on it says nothing of where the robot is now


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


class MapTransform:
    """Publishes map to odom, so that map to base on /tf is the pose that was published.

    With each frame it goes out twice: with the frame's stamp, for those who ask where the robot
    was when it scanned, and dated ahead by ``transform_tolerance``, as AMCL does, for those who
    ask where it is now. The second is repeated every ``transform_publish_period`` with the date
    of then, until SILENT after the last frame. A period of 0, which it may become at run time, or
    ``tf_broadcast`` false: nothing is published.
    """

    def __init__(self, node: Any, params: Node, smoothed: Smoothing | None = None) -> None:
        self._node, self._p, self._smoothed = node, params, smoothed
        self._frames = params.map_frame, params.odom_frame
        self._publisher: TransformPublisher | None = None
        self._publisher = self._open()
        self._odom = OdomFrame()
        self._newest: tuple[int, Array] | None = None
        self._heard = self._dated = 0

    @property
    def _is_sent(self) -> bool:
        p = self._p
        return p.tf_broadcast and not p.shadow and p.transform_publish_period > 0.0

    def _open(self) -> TransformPublisher | None:
        """The publisher, from when anything is to be published."""
        if self._publisher is None and self._is_sent:
            return TransformPublisher(self._node)
        return self._publisher

    def restart(self) -> None:
        """The local frame is another one from now on."""
        self._odom.restart()
        self._newest, self._dated = None, 0

    def follow(self, frame: Frame) -> None:
        """Take the next frame, and publish."""
        self._odom.follow(frame)
        self._publisher = self._open()
        if self._odom.newest is None or self._publisher is None or not self._is_sent:
            return
        stamp, T = self._odom.newest
        if self._smoothed is not None:
            T = self._smoothed(stamp, T, self._odom.T_odom_base)
        if self._newest is not None and stamp < self._newest[0]:
            self._dated = 0
        self._newest, self._heard = (stamp, T), self._now()
        self._publisher.publish(stamp, self._frames, T)
        self._dated = max(self._dated, stamp)
        self.repeat()

    def repeat(self) -> None:
        """Publish the newest one dated ahead, if that is later than what was sent."""
        if self._newest is None or self._publisher is None or not self._is_sent:
            return
        stamp, T = self._newest
        since = self._now() - self._heard
        # a buffer ignores the second of two with one stamp, and that of a scan has to come in:
        # stamps are multiples of more than a nanosecond, where they may meet
        date = stamp + since + int(self._p.transform_tolerance * SECOND) - 1
        if self._p.transform_tolerance > 0.0 and 0 <= since <= SILENT and date > self._dated:
            self._dated = date
            self._publisher.publish(date, self._frames, T)

    def _now(self) -> int:
        """The node's time [ns], simulated where that is used."""
        return int(self._node.get_clock().now().nanoseconds)
