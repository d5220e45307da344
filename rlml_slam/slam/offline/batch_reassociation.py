# SPDX-License-Identifier: Apache-2.0
"""Batch re-association after a run on reflectors without ids and odometry alone.

During the run an ambiguous detection is not used, and reflectors closer together than the error of
the pose count as one. At the end every detection is associated again with the reflectors as
estimated (batch_association.py), and the path is smoothed with the new associations, alternately
until nothing changes. Wrong associations between two reflectors displace the path by up to their
distance: in the first iteration each detection gets that much additional noise, in each later one
half of the variance before (graduated assignment: Gold, Rangarajan 1996). At the end, two close
reflectors that were never seen together and have no gap between their detections are merged. The
back end then processes the run once more with these associations.

With scans it is not needed: they constrain the path, and the graph contains them.
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
from rlml_slam.slam.offline.batch_association import BatchAssociation, ReflectorPoints
from rlml_slam.types import ANONYMOUS, Frame, Observation, Reflectors

MAX_ITERATIONS = 20
ANNEALED = 10  # iterations with additional variance, the last one 0.1 % of the first
SMOOTHER_STEPS = 3  # Gauss-Newton steps of an iteration

Indices = NDArray[np.int64]


class BatchReassociation:
    """Keeps the measurements of a run, while they are reflectors and odometry alone."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._frames: list[Frame] = []
        self._steps: list[Step] = []
        self._limit = gate(params.reflector.gate)
        self._is_open = params.node.mode == 'mapping' and params.node.use_odom

    def close(self) -> None:
        """Drop the measurements: the graph contains more than these."""
        self._is_open = False
        self._frames, self._steps = [], []

    def add(self, observation: Observation, frame: Frame) -> None:
        """Keep an observation and its frame; with a scan, nothing is kept any more."""
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

    def reassociate(self, poses: Array, reflectors: Reflectors) -> list[Frame]:
        """Frames with new associations, from the graph's ``poses`` (n, 3) and reflectors.

        Their local frame is the map; landmarks are numbered from 0. Empty where nothing was kept.
        """
        if not self._is_open or not len(reflectors) or len(poses) != len(self._steps):
            return []
        match = BatchAssociation(
            [f.observation.detections for f in self._frames], self._p.reflector
        )
        estimate = ReflectorPoints(reflectors.points, reflectors.ids)
        associations: Indices = np.zeros(0, dtype=np.int64)
        for turn in range(MAX_ITERATIONS):
            before = associations
            extra_variance = self._extra_variance(turn) if match.is_ambiguous else 0.0
            estimate, associations = match.associate(poses, estimate, extra_variance)
            if not len(estimate.points):
                return []
            steps = self._sights(match, associations, poses, estimate.points, extra_variance)
            smoothed = smooth(self._start(), steps, POINT, poses, SMOOTHER_STEPS)
            poses, estimate = (
                smoothed.states[:, :3],
                ReflectorPoints(smoothed.points, estimate.ids),
            )
            if not extra_variance and np.array_equal(before, associations):
                break
        estimate, associations = match.joined(estimate, associations)
        steps = self._sights(match, associations, poses, estimate.points, 0.0)
        smoothed = smooth(self._start(), steps, POINT, poses, SMOOTHER_STEPS)
        return self._corrected(smoothed, match.by_frame(associations))

    def _extra_variance(self, turn: int) -> float:
        """Additional variance per axis [m²] of the detections in an iteration."""
        return 0.5**turn * self._p.reflector.min_separation**2 if turn < ANNEALED else 0.0

    def _start(self) -> Start:
        """First pose, which defines the map, and the prior of bias and scale errors."""
        m = self._p.motion
        sigma = np.array([0.0, 0.0, 0.0, m.imu_bias_sigma, *m.first_scale_errors])
        return Start(np.append(self._p.node.map_start_pose, np.zeros(3)), np.diag(sigma**2))

    def _sights(
        self,
        match: BatchAssociation,
        associations: Indices,
        poses: Array,
        points: Array,
        extra_variance: float,
    ) -> list[Step]:
        """Steps with their sights, weighted by the Cauchy loss.

        ``extra_variance`` [m²] is added to the covariance of each detection.
        """
        used = np.flatnonzero(associations >= 0)
        keys, of = associations[used], match.frame_of[used]
        z, R = to_polar(match.z[used], match.R[used] + extra_variance * np.eye(2))
        nu = POINT.innovation(z, POINT.observe(poses[of], points[keys])[0])
        R *= (1.0 + _distance2(nu, R) / self._p.reflector.robust_scale**2)[:, None, None]
        sights = [Sight(*one) for one in zip(keys.tolist(), z, R, strict=True)]
        counts = np.bincount(of, minlength=len(self._steps)).tolist()
        return [
            dataclasses.replace(step, sights=tuple(sights[end - count : end])) if count else step
            for step, count, end in zip(self._steps, counts, np.cumsum(counts), strict=True)
        ]

    def _corrected(self, smoothed: Smoothed, looks: Sequence[Indices]) -> list[Frame]:
        """Frames whose measurements agree with the smoothed path and reflectors.

        The graph of them has its minimum at the smoothed estimate; the covariances are those
        of the measurements.
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
                at[
                    used[off & (d.ids[used] != ANONYMOUS)]
                ] = -1  # associated by its id, but outside the gate
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
