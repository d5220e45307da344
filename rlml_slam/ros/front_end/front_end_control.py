# SPDX-License-Identifier: Apache-2.0
"""What a front end is told from outside: where it is, which map it is in, and corrections."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import ReferencePose
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.belief_message import read_belief
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map
from rlml_slam.ros.front_end.frame_publisher import FramePublisher
from rlml_slam.ros.sensors import LATCHED, RELIABLE, checked
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Frame, Observation, Reflectors

RECENT = 1000  # frames that an initialpose or a correction may be of: both take their time
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
CLOUD = 'sensor_msgs/msg/PointCloud2'
GRID = 'nav_msgs/msg/OccupancyGrid'


class FrontEndControl:
    """Owns a FrontEnd, which begins anew where it is told to; ``map`` is what it localizes in.

    ``last`` is the newest frame. Every beginning is a new session of ``answers``.
    """

    def __init__(self, node: Any, params: Parameters, answers: FramePublisher) -> None:
        self._logger = node.get_logger()
        self._p = params
        self._answers = answers
        self.front_end = FrontEnd(params)
        self.map: Reflectors | None = None
        self.grid: OccupancyGrid | None = None
        self.last: Frame | None = None
        # stamp, T_local_base (3,) and its covariance (3, 3)
        self._recent: deque[tuple[int, Array, Array]] = deque(maxlen=RECENT)
        for kind, topic, callback, qos in (
            (POSE, 'initialpose', self.start_at, RELIABLE),
            (POSE, 'correction', self.correct, LATCHED),
            (CLOUD, 'belief', self.believe, RELIABLE),
            (POSE, 'relocation', self.relocate, RELIABLE),
            (GRID, 'localization_grid', self.use_grid, LATCHED),
            (CLOUD, 'localization_map', self.use_map, LATCHED),
        ):
            node.create_subscription(rclpy_class(kind), topic, checked(node, callback), qos)

    def process(self, observation: Observation) -> Frame:
        """One observation."""
        frame = self.last = self.front_end.process(observation)
        self._recent.append((frame.stamp, frame.T_local_base, frame.cov_local))
        return frame

    def restart(self) -> None:
        """Forget everything: the clock jumped back."""
        self._begin(np.array(self._p.node.map_start_pose), np.zeros((3, 3)))

    def start_at(self, msg: Any) -> None:
        """Begin anew at a pose of the map; one with the stamp of a frame is of that moment."""
        start = decode.start_pose(msg, self._p.node.map_frame)
        pose = start.pose
        for stamp, T_local_base, _ in self._recent:
            if stamp == start.stamp:
                moved = se2.between(T_local_base, self.front_end.state.pose)
                pose = se2.compose(pose, moved)
        self._begin(pose, start.cov)
        self._logger.info(f'begins at {np.round(pose, 3).tolist()}')

    def relocate(self, msg: Any) -> None:
        """Go on in the same map from where the back end found a frame that was lost.

        Who has found itself meanwhile, or was told another place, does not jump.
        """
        found = decode.pose_estimate(msg, 'relocation')
        front_end = self.front_end
        if not front_end.kidnapping.since:
            return
        for stamp, T_local_base, _ in self._recent:
            if stamp == found.stamp and stamp >= front_end.kidnapping.since:
                moved = se2.between(T_local_base, front_end.state.pose)
                front_end.relocate(se2.compose(found.pose, moved), found.cov)
                self._recent.clear()
                self._logger.info(f'found again at {np.round(found.pose, 3).tolist()}')
                return

    def use_grid(self, msg: Any) -> None:
        """The grid that belongs to the map of the back end; one without cells is none."""
        self.grid = decode.occupancy_grid(msg, 'localization_grid')
        if self.map is not None:
            self.front_end.use_grid(self.grid)

    def use_map(self, msg: Any) -> None:
        """Localise in the map of the back end from where the robot is; without fields, map."""
        self.map = read_reflector_map(msg, 'localization_map') if msg.fields else None
        mode = 'mapping' if self.map is None else 'localization'
        node = dataclasses.replace(self._p.node, mode=mode)
        self.front_end = FrontEnd(dataclasses.replace(self._p, node=node))
        if self.last is None:
            self.restart()
        else:
            self._begin(self.last.T_map_base, self.last.cov_map)
        known = '' if self.map is None else f' in a map of {len(self.map)} reflectors'
        self._logger.info(f'mode is {mode}{known}')

    def _begin(self, pose: Array, cov: Array) -> None:
        self.front_end.reset(pose, cov)
        if self.map is not None:
            self.front_end.use_map(self.map, self.grid)
        self._recent.clear()
        self._answers.begin_session()

    def believe(self, msg: Any) -> None:
        """Go on from the back end's graph where it contradicts this end's pose of now."""
        said = read_belief(msg)
        if said.session == self._answers.session:
            self.front_end.correct(said.T_map_local)
            self.front_end.forget(said.belief.removed)
            fresh = said.stamp == self.front_end.newest
            if fresh and self.front_end.contradicts(said.belief):
                self.front_end.adopt(said.belief)

    def correct(self, msg: Any) -> None:
        """Take over T_map_local from the back end, if it is of a frame of this session.

        The topic keeps the newest one for who comes later, and the back end may be behind: one of
        another local frame means nothing in this.
        """
        correction = decode.pose_estimate(msg, 'correction')
        for stamp, T_local_base, cov_local in self._recent:
            if stamp == correction.stamp:
                # zeros are those of a graph that says nothing, and of no pose
                told = correction.cov.any()
                known = ReferencePose(T_local_base, cov_local, correction.cov) if told else None
                self.front_end.correct(correction.pose, known)
                return
