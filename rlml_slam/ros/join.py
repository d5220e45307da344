# SPDX-License-Identifier: Apache-2.0
"""The back end's view of the front end: observations and poses of one stamp become frames."""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import STILL, compose_motion
from rlml_slam.params import Parameters
from rlml_slam.ros.associated import Associated
from rlml_slam.ros.convert import PoseEstimate
from rlml_slam.sensing.sequence import PAIRING
from rlml_slam.types import Frame, Motion, Observation

MAX_WAITING = 2000  # observations or poses without their other half; the oldest are dropped
WAIT = 2.0  # [s] of stamps that a scan waits for the front end's detections
# the local frame is continuous: a larger step against the odometry is another front end's
RESTART = np.array([2.0, 2.0, 1.0])


class FrameJoin:
    """Two ordered streams are merged by stamp; each ``add_…`` returns what became whole.

    An observation that the front end never answered, or that came while ``paused``, adds its
    motion to the next one.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._observations: deque[Observation] = deque(maxlen=MAX_WAITING)
        self._poses: deque[PoseEstimate] = deque(maxlen=MAX_WAITING)
        self._associated: dict[int, Associated] = {}
        self._pending: Motion = STILL
        self.paused = False
        self.unanswered = 0

    def add_observation(self, observation: Observation) -> list[Frame]:
        """What the sensors said at one stamp."""
        self._observations.append(observation)
        return self._merge()

    def add_pose(self, pose: PoseEstimate) -> list[Frame]:
        """The front end's pose in its local frame."""
        self._poses.append(pose)
        return self._merge()

    def add_associated(self, associated: Associated) -> None:
        """The landmarks of the detections of one stamp; they come before the pose."""
        self._associated[associated.detections.stamp] = associated
        while len(self._associated) > MAX_WAITING:
            del self._associated[next(iter(self._associated))]

    def _merge(self) -> list[Frame]:
        out = []
        while self._observations and self._poses:
            observation, pose = self._observations[0], self._poses[0]
            if pose.stamp > observation.stamp + PAIRING:
                self._pending = compose_motion(self._pending, observation.motion)
                self._observations.popleft()
                self.unanswered += 1
            elif pose.stamp < observation.stamp - PAIRING:
                self._poses.popleft()
                self._associated.pop(pose.stamp, None)
            else:
                self._observations.popleft()
                self._poses.popleft()
                if self.paused:
                    self._pending = compose_motion(self._pending, observation.motion)
                else:
                    out.append(self._frame(observation, pose))
        return out

    def _frame(self, observation: Observation, pose: PoseEstimate) -> Frame:
        motion = compose_motion(self._pending, observation.motion)
        self._pending = STILL
        found = self._associated.pop(pose.stamp, None)
        none = np.zeros(0, dtype=np.int64)
        detections = observation.detections
        if found is None or detections is None or len(detections) != len(found.landmarks):
            found, detections = None, None
        matched = (
            observation.points is not None
            and len(observation.points) >= self._p.scan_match.min_points
        )
        return Frame(
            stamp=pose.stamp,
            observation=dataclasses.replace(observation, motion=motion, detections=detections),
            T_local_base=pose.pose,
            cov_local=pose.cov,
            T_map_base=pose.pose,
            cov_map=pose.cov,
            landmarks=none if found is None else found.landmarks,
            statuses=none if found is None else found.statuses,
            # the score itself stays with the front end; the back end asks whether there was one
            scan_score=1.0 if matched else float('nan'),
        )


def restarted(before: Frame, after: Frame) -> bool:
    """Whether the front end began anew between two frames: its local frame is another one."""
    step = se2.between(before.T_local_base, after.T_local_base)
    error = np.abs(se2.between(after.observation.motion.delta, step))
    return bool(np.any(error > RESTART) and after.observation.motion.known)


def follower(params: Parameters) -> Parameters:
    """Parameters for a sequencer behind the front end: it waits longer and leaves nothing out."""
    node = params.node
    return dataclasses.replace(
        params,
        node=dataclasses.replace(
            node, transform_timeout=max(WAIT, node.transform_timeout), use_reflectors=True
        ),
        reflector=dataclasses.replace(params.reflector, max_range=1000.0),
    )
