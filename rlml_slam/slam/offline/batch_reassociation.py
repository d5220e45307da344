# SPDX-License-Identifier: Apache-2.0
"""A run on reflectors and odometry alone, looked at again when it is over.

While it goes on, a detection that fits several reflectors is used for none, and those that stand
closer than can be told apart count as one. In the end the whole run tells which is which: every
detection is matched once more to the reflectors as they turned out to be (:mod:`second_match`),
and the path is smoothed by the new answers; in turns, until nothing changes. A path by answers
that cannot tell two reflectors apart errs by as much as they are apart: the first turn grants each
detection that much besides its noise, each later one half the variance of the one before
(graduated assignment: Gold, Rangarajan 1996). So a look at a group finds all of it, where the path
is off by one of its gaps, before what is left over may be a further reflector, and a wrong answer
of the first turns is taken back later. At the end, two that are close, never seen together and not
parted by a gap are one. The back end then goes through the run once more, as it should have been,
and takes nothing for one that was told apart: its map is the only one.

With scans there is no need: they hold the path by themselves, and the graph has them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.estimation.landmark_models import POINT, to_polar
from rlml_slam.estimation.smoother import Sight, Smoothed, Start, Step, smooth
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.batch_association import BatchAssociation, Marks
from rlml_slam.types import ANONYMOUS, Frame, Observation, Reflectors

TURNS = 20
COLD = 10  # turns until what is granted is no more: 0.1 % of the first variance
STEPS = 3  # Gauss-Newton steps of a turn: the next one corrects what is left

Indices = NDArray[np.int64]


class BatchReassociation:
    """Keeps what was measured, as long as it is reflectors and odometry alone."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._frames: list[Frame] = []
        self._steps: list[Step] = []
        self._limit = gate(params.reflector.gate)
        self._is_open = params.node.mode == 'mapping' and params.node.use_odom

    def close(self) -> None:
        """There will be nothing to look back on: the graph knows better."""
        self._is_open = False
        self._frames, self._steps = [], []

    def add(self, observation: Observation, frame: Frame) -> None:
        """Keep an observation and what the front end made of it; with a scan, none is kept."""
        if not self._is_open:
            return
        is_long = len(self._steps) >= self._p.back_end.max_trajectory_frames
        known = observation.motion.known or not self._frames
        if observation.points is not None or frame.jumped or not known or is_long:
            self.close()
            return
        m = self._p.motion
        dt = 1e-9 * (frame.stamp - self._frames[-1].stamp) if self._frames else 0.0
        walk, kept = m.imu_bias_walk**2 * dt, math.exp(-dt / m.scale_error_time)
        self._steps.append(Step(observation.motion, walk, kept))
        # as measured: what the front end grants the detections of a group is no noise in the end
        measured = dataclasses.replace(frame.observation, detections=observation.detections)
        self._frames.append(dataclasses.replace(frame, observation=measured))

    def look_back(self, poses: Array, reflectors: Reflectors) -> list[Frame]:
        """The frames as they should have been, from the graph's ``poses`` (n, 3) and reflectors.

        Their local frame is that of the map; landmarks are numbered from 0. Empty if there is
        nothing to look back on.
        """
        if not self._is_open or not len(reflectors) or len(poses) != len(self._steps):
            return []
        match = BatchAssociation(
            [f.observation.detections for f in self._frames], self._p.reflector
        )
        marks = Marks(reflectors.points, reflectors.ids)
        answers: Indices = np.zeros(0, dtype=np.int64)
        for turn in range(TURNS):
            before = answers
            granted = self._granted(turn) if match.is_open else 0.0
            marks, answers = match.answer(poses, marks, granted)
            if not len(marks.points):
                return []
            steps = self._sights(match, answers, poses, marks.points, granted)
            smoothed = smooth(self._start(), steps, POINT, poses, STEPS)
            poses, marks = smoothed.states[:, :3], Marks(smoothed.points, marks.ids)
            if not granted and np.array_equal(before, answers):
                break
        marks, answers = match.joined(marks, answers)
        steps = self._sights(match, answers, poses, marks.points, 0.0)
        smoothed = smooth(self._start(), steps, POINT, poses, STEPS)
        return self._told(smoothed, match.looks(answers))

    def _granted(self, turn: int) -> float:
        """Variance per axis [m²] by which the path may err in a turn."""
        return 0.5**turn * self._p.reflector.min_separation**2 if turn < COLD else 0.0

    def _start(self) -> Start:
        """Where the run began, which defines the map, and what is not known of gyro and wheels."""
        m = self._p.motion
        sigma = np.array([0.0, 0.0, 0.0, m.imu_bias_sigma, *m.scale_error_sigma])
        return Start(np.append(self._p.node.map_start_pose, np.zeros(3)), np.diag(sigma**2))

    def _sights(
        self,
        match: BatchAssociation,
        answers: Indices,
        poses: Array,
        points: Array,
        granted: float,
    ) -> list[Step]:
        """The steps with what each one saw; by Cauchy's loss, what is far off counts less.

        Answers that may be off by the variance ``granted`` tell the path no more than that.
        """
        steps = []
        for step, frame, at, pose in zip(
            self._steps, self._frames, match.looks(answers), poses, strict=True
        ):
            d, used = frame.observation.detections, np.flatnonzero(at >= 0)
            if d is None or not len(used):
                steps.append(step)
                continue
            z, R = to_polar(d.points[used], d.cov[used] + granted * np.eye(2))
            nu = POINT.innovation(z, POINT.observe(pose, points[at[used]])[0])
            d2 = _distance2(nu, R)
            R *= (1.0 + d2 / self._p.reflector.robust_scale**2)[:, None, None]
            sights = tuple(map(Sight, at[used].tolist(), z, R))
            steps.append(dataclasses.replace(step, sights=sights))
        return steps

    def _told(self, smoothed: Smoothed, looks: Sequence[Indices]) -> list[Frame]:
        """The frames as they should have been: all that is measured is where the end has it.

        So the graph of them has its minimum where the run turned out to be. What it knows is as
        much as was measured, for the covariances stay.
        """
        poses = np.concatenate([smoothed.start[None, :3], smoothed.states[:, :3]])
        out = []
        for frame, a, b, at in zip(self._frames, poses[:-1], poses[1:], looks, strict=True):
            motion = dataclasses.replace(frame.observation.motion, delta=se2.between(a, b))
            observation = dataclasses.replace(frame.observation, motion=motion)
            if (d := observation.detections) is not None:
                points, at = d.points.copy(), at.copy()
                used = np.flatnonzero(at >= 0)
                points[used] = se2.transform(se2.inverse(b), smoothed.points[at[used]])
                off = _distance2(d.points[used] - points[used], d.cov[used]) > self._limit
                at[used[off & (d.ids[used] != ANONYMOUS)]] = -1  # told by an id, but elsewhere
                observation = dataclasses.replace(
                    observation, detections=dataclasses.replace(d, points=points)
                )
            out.append(
                dataclasses.replace(
                    frame, observation=observation, landmarks=at, T_local_base=b.copy()
                )
            )
        return out


def _distance2(nu: Array, cov: Array) -> Array:
    """Squared Mahalanobis distances (k,) of nu (k, 2)."""
    return np.asarray(np.einsum('ki,ki->k', nu, np.linalg.solve(cov, nu[..., None])[..., 0]))
