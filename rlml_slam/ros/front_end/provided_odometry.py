# SPDX-License-Identifier: Apache-2.0
"""Odometry for a robot that has none: odom to base on /tf, from the front end's local frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Node
from rlml_slam.ros.tf import TransformPublisher
from rlml_slam.se2 import Array
from rlml_slam.types import Frame


class ProvidedOdometry:
    """Publishes odom to base where a frame has no odometry; it goes on across sessions."""

    def __init__(self, node: Any, params: Node) -> None:
        self._frames = params.odom_frame, params.base_frame
        is_sent = params.tf_broadcast and not params.shadow
        self._publisher = TransformPublisher(node, '~/odom_to_base') if is_sent else None
        self._T_odom_base: Array = np.zeros(3)
        self._T_odom_local: Array | None = np.zeros(3)

    def begin_session(self) -> None:
        """The local frame is another one from now on; the robot is where it was."""
        self._T_odom_local = None

    def publish(self, frame: Frame) -> Frame:
        """The frame with this odometry, which is sent; one that has odometry as it is."""
        if frame.observation.odom_pose is not None:
            return frame
        if self._T_odom_local is None:
            self._T_odom_local = se2.compose(self._T_odom_base, se2.inverse(frame.T_local_base))
        self._T_odom_base = se2.compose(self._T_odom_local, frame.T_local_base)
        if self._publisher is not None:
            self._publisher.publish(frame.stamp, self._frames, self._T_odom_base)
        observation = replace(frame.observation, odom_pose=self._T_odom_base)
        return replace(frame, observation=observation)
