# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM steps for each observation: predict, associate, update, augment."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections import Counter
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.ekf.branch import Associations, Branch, MeasuredFrame, most_branches
from rlml_slam.ekf.contradiction import Contradiction
from rlml_slam.ekf.extraction import Measured, measure
from rlml_slam.ekf.filter import Filter
from rlml_slam.ekf.likelihood import DECORRELATION
from rlml_slam.ekf.matching import Matcher
from rlml_slam.estimation.health import HealthInputs, HealthMonitor, ScanEvidence
from rlml_slam.estimation.kidnapping_detection import agree_with_map
from rlml_slam.estimation.landmark_models import POINT, line_model
from rlml_slam.estimation.smoother import Smoothed, Start, smooth
from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.grid_localization import GridMatch
from rlml_slam.slam.front_end.map_localization import MapConfirmation
from rlml_slam.slam.landmarks.delayed_association import SLIP2
from rlml_slam.types import Frame, Observation, Reflectors, Status

MAX_LOG_RATIO = 10.0  # of the weights of the best branch and one that is dropped
BLIND = 3.0  # [s] without a landmark after which wheel slip would not be noticed
MAP_TRAVEL, MAP_TURN = 0.3, 0.25  # [m], [rad] between two scans that are drawn into the grid


class Estimator:
    """Branches and results; one branch as long as all associations are unique."""

    def __init__(self, params: EkfParameters, keep_steps: bool = False) -> None:
        """``keep_steps``: the measurements are kept, to smooth the path in the end."""
        self._p = params
        self._keeps_steps = keep_steps
        e = params.ekf
        self.model = line_model(np.array(e.line_origin)) if e.extractor == 'lines' else POINT
        self._matcher = Matcher(params)
        self.reset(np.array(params.node.map_start_pose), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array) -> None:
        """Start again at a pose (3,) of the map with covariance (3, 3)."""
        # the invariant error is defined for points only
        invariant = self._p.ekf.error_model == 'invariant' and self.model is POINT
        m = self._p.motion
        filter_ = Filter(pose, cov, m.imu_bias_sigma, self.model, invariant, m.scale_error_sigma)
        self._start = Start(filter_.x.copy(), filter_.P.copy())
        self.branches = [Branch(self._p, self._matcher, filter_)]
        self.health = HealthMonitor(self._p.health)
        self.confirmation = MapConfirmation(self._p)
        self.contradiction = Contradiction(self._p.health)
        self.fates: Counter[str] = Counter()
        self._mapping = self._p.node.mode == 'mapping'
        self._last_stamp: int | None = None
        self._since = np.zeros(2)  # distance and turn since the last measurement
        self._next_key = 0
        self._last_used = 0
        self._drawn: list[tuple[int, Array, Array, Array]] = []

    @property
    def filter(self) -> Filter:
        """Filter of the likeliest branch."""
        return self.branches[0].filter

    def use_map(self, reflectors: Reflectors) -> None:
        """Localize with given landmarks (map frame); no others are added from now on.

        A start pose without covariance is an assumption, and gets START_SIGMA.
        """
        if not self.filter.pose_cov.any():
            self.reset(self.filter.pose, np.diag(np.array(self._p.node.map_start_sigma) ** 2))
        self.confirmation.begin()
        self._mapping = False
        self._keeps_steps = False  # the map is of another drive
        for branch in self.branches:
            branch.use_map(reflectors)

    def process(self, observation: Observation) -> Frame:
        """The pose at the observation's stamp."""
        began = time.perf_counter()
        self._predict(observation)
        seen = measure(observation, self._p)
        if seen is not None:
            self._update(seen, observation.stamp)
        for branch in self.branches:
            branch.path.append(observation.stamp, branch.filter.pose, self._keeps_steps)
        self._draw(observation)
        return self._frame(observation, seen, self.branches[0].associations, began)

    def _predict(self, observation: Observation) -> None:
        motion = observation.motion
        if self._matcher.defers and observation.stamp - self._last_used > BLIND * 1e9:
            motion = dataclasses.replace(motion, cov=SLIP2 * motion.cov)
        dt = 0.0
        if self._last_stamp is not None:
            dt = (observation.stamp - self._last_stamp) * 1e-9
        self._last_stamp = observation.stamp
        m = self._p.motion
        for branch in self.branches:
            branch.predict(motion, m.imu_bias_walk**2 * dt, math.exp(-dt / m.scale_error_time))
        self._since += [np.hypot(motion.delta[0], motion.delta[1]), abs(motion.delta[2])]

    def _update(self, seen: Measured, stamp: int) -> None:
        """Associate, update, augment in every branch; keep the likely ones.

        Errors of a sensor are correlated: frames from one place count as one.
        """
        weight = min(float((self._since / DECORRELATION).max()), 1.0)
        if len(seen.z):
            self._since = np.zeros(2)
        keys = itertools.count(self._next_key)
        key_of = cache(lambda i: next(keys))
        frame = MeasuredFrame(seen, stamp, weight, self._mapping, key_of)
        self.branches = _best(
            [child for b in self.branches for child in b.update(frame)], len(seen.z)
        )
        self._next_key = next(keys)
        if (self.branches[0].associations.statuses == Status.USED).any():
            self._last_used = stamp
        self.fates.update(Status(s).name for s in self.branches[0].associations.statuses)

    def _draw(self, observation: Observation) -> None:
        """Keep a scan for the grid where the robot has moved since the last one kept."""
        if observation.points is None or observation.origin is None:
            return
        pose = self.filter.pose
        if self._drawn:
            last = self._drawn[-1][1]
            moved = np.hypot(*(pose[:2] - last[:2])) >= MAP_TRAVEL
            if not moved and abs(np.sin(0.5 * (pose[2] - last[2]))) < np.sin(0.5 * MAP_TURN):
                return
        self._drawn.append((observation.stamp, pose, observation.points, observation.origin))

    def _frame(
        self,
        observation: Observation,
        seen: Measured | None,
        associations: Associations,
        began: float,
    ) -> Frame:
        pose, cov = self.filter.pose, self.pose_cov
        keys, statuses = associations.keys, associations.statuses
        if seen is not None:  # keys and statuses belong to the measurements
            observation = dataclasses.replace(observation, detections=seen.detections)
        n, used = len(statuses), int((statuses == Status.USED).sum())
        travel = float(np.hypot(*observation.motion.delta[:2]))
        in_map = self.confirmation
        agree = agree_with_map(n, used)
        in_map.check(observation.stamp, travel, n, used, agree, GridMatch(math.nan))
        elsewhere = self.contradiction
        if self.model is POINT and not (self._mapping or in_map.is_pending):
            near = se2.transform(se2.inverse(pose), self.filter.points)
            z = np.zeros((0, 2)) if seen is None else seen.z
            elsewhere.check(observation.stamp, z, used, near)
        health = self.health.evaluate(
            observation.stamp,
            HealthInputs(
                scan=ScanEvidence(),
                has_odometry=observation.motion.known,
                detections=None if seen is None else n,
                matched=used,
                cov_map=cov,
                unconfirmed=in_map.reason or elsewhere.reason,
                is_lost=in_map.is_lost or elsewhere.is_lost,
                maps=self._mapping,
                position=pose[:2],
            ),
        )
        return Frame(
            stamp=observation.stamp,
            observation=observation,
            T_local_base=pose,
            cov_local=cov,
            T_map_base=pose,
            cov_map=cov,
            landmarks=keys,
            statuses=statuses,
            health=health,
            unconfirmed=in_map.is_pending,
            chi2=associations.chi2,
            wall_ms=(time.perf_counter() - began) * 1e3,
        )

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) in the map frame, as the likeliest branch had them live."""
        path = self.branches[0].path.nodes()
        return (
            np.array([p.stamp for p in path], dtype=np.int64),
            np.array([p.pose for p in path]).reshape(-1, 3),
        )

    def smoothed(self) -> Smoothed | None:
        """Smoothed path of the likeliest branch, None where its steps were not kept."""
        steps = self.branches[0].path.steps()
        if not steps:
            return None
        return smooth(self._start, steps, self.model, self.trajectory()[1])

    def reflectors(self) -> Reflectors:
        """All landmarks of the state, in the map frame."""
        return self.branches[0].reflectors()

    @property
    def pose_cov(self) -> Array:
        """Covariance (3, 3) of the likeliest pose, of the mixture of all branches."""
        weights = np.exp([b.weight for b in self.branches])
        weights /= weights.sum()
        best = self.branches[0].filter.pose
        out = np.zeros((3, 3))
        for w, b in zip(weights, self.branches, strict=True):
            d = b.filter.pose - best
            d[2] = se2.wrap(d[2])
            out += w * (b.filter.pose_cov + np.outer(d, d))
        return out

    def occupancy_grid(
        self, path: tuple[NDArray[np.int64], Array] | None = None
    ) -> OccupancyGrid | None:
        """The kept scans at the poses of their time, or of a ``path``; None without any."""
        kept = [d for d in self._drawn if len(d[2])]
        if not kept:
            return None
        stamps, poses, points, origins = zip(*kept, strict=True)
        if path is not None:
            poses = tuple(path[1][np.searchsorted(path[0], stamps)])
        resolution = self._p.back_end.resolution
        return render(np.array(poses), list(points), list(origins), resolution)


def _best(branches: Sequence[Branch], measurements: int) -> list[Branch]:
    """The likely branches, the likeliest first, without duplicates."""
    different: list[Branch] = []
    for b in sorted(branches, key=lambda b: -b.weight):
        twin = next((d for d in different if d.equals(b)), None)
        if twin is None:
            different.append(b)
        else:
            twin.weight = float(np.logaddexp(twin.weight, b.weight))
    most = most_branches(measurements, max(len(b.filter.x) for b in different))
    different.sort(key=lambda b: -b.weight)
    best = different[0].weight
    kept = [b for b in different[:most] if b.weight > best - MAX_LOG_RATIO]
    for b in kept:
        b.weight -= best
    return kept
