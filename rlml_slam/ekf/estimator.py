# SPDX-License-Identifier: Apache-2.0
"""The note's processing steps for each observation: predict, associate, update, augment."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rlml_slam.ekf.association import compatible_ids, mahalanobis2, nearest
from rlml_slam.ekf.candidates import Candidates
from rlml_slam.ekf.extraction import Measured, measure
from rlml_slam.ekf.filter import Filter
from rlml_slam.ekf.models import POINT, line_model
from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.matching.association import Associator, Believed
from rlml_slam.params import EkfParameters
from rlml_slam.rlml.health import Evidence, HealthMonitor
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections, Frame, Observation, Reflectors, Status

MAP_TRAVEL, MAP_TURN = 0.3, 0.25  # [m], [rad] between two scans that are drawn into the grid


class Estimator:
    """Filter, candidates and bookkeeping; ``process`` is the system."""

    def __init__(self, params: EkfParameters) -> None:
        self._p = params
        e = params.ekf
        lines = e.extractor == 'lines'
        self.model = line_model(np.array(e.line_origin)) if lines else POINT
        self._gate, self._new_gate = (float(chi2.ppf(p, 2)) for p in (e.gate, e.new_gate))
        self._joint: Associator | None = None
        if e.association == 'joint' and not lines:
            self._joint = Associator(
                dataclasses.replace(
                    params.reflector, gate=e.gate, new_gate=e.new_gate,
                    min_separation=e.min_separation,
                )
            )  # fmt: skip
        self.reset(np.array(params.node.map_start_pose), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array) -> None:
        """Forget everything and start at a pose (3,) of the map with covariance (3, 3)."""
        # a line is no point that turns with the rest
        invariant = self._p.ekf.error == 'invariant' and self.model is POINT
        self.filter = Filter(pose, cov, self._p.motion.imu_bias, self.model, invariant)
        self.candidates = Candidates(self.model)
        self.health = HealthMonitor(self._p.health)
        self.ids = np.zeros(0, dtype=np.int64)
        self.sightings = np.zeros(0, dtype=np.int64)
        self.diameters = np.zeros(0)
        self.fates: Counter[str] = Counter()
        self._mapping = self._p.node.mode == 'mapping'
        self._region: Array | None = None
        self._radius = self._reach = 0.0
        self._last_stamp: int | None = None
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._drawn: list[tuple[Array, Array, Array]] = []

    def use_map(self, reflectors: Reflectors) -> None:
        """Localise against given landmarks (map frame); no others are added from now on."""
        self.filter.settle()
        self._mapping = False
        for k in range(len(reflectors)):
            self.filter.fix(reflectors.points[k], reflectors.cov[k])
            self._note(
                int(reflectors.ids[k]), int(reflectors.sightings[k]), reflectors.diameters[k]
            )

    def process(self, observation: Observation) -> Frame:
        """The pose at the observation's stamp."""
        began = time.perf_counter()
        self._predict(observation)
        seen = measure(observation, self._p)
        self._choose_region(seen)
        k = 0 if seen is None else len(seen.z)
        keys = np.full(k, -1, dtype=np.int64)
        statuses = np.full(k, Status.NEW, dtype=np.int64)
        chi2_sum = 0.0
        if seen is not None and k:
            slots, statuses, distance2 = self._associate(seen.z, seen.R, seen.detections)
            used = slots >= 0
            keys[used] = self.filter.local[slots[used]]
            self._update(seen.z, seen.R, slots, seen.detections)
            self._grow(observation.stamp, seen.z, seen.R, seen.detections, keys, statuses)
            chi2_sum = float(distance2[used].sum())
        self._draw(observation)
        return self._frame(observation, seen, keys, statuses, chi2_sum, began)

    # --- step 1: odometry --------------------------------------------------------------------

    def _predict(self, observation: Observation) -> None:
        motion = observation.motion
        dt = 0.0
        if self._last_stamp is not None:
            dt = (observation.stamp - self._last_stamp) * 1e-9
        self._last_stamp = observation.stamp
        self.filter.predict(motion, self._p.motion.imu_bias_walk**2 * dt)
        delta = motion.delta + motion.bias_gain * self.filter.x[3]
        self.candidates.move(delta, motion.cov)

    def _choose_region(self, seen: Measured | None) -> None:
        """Work on the landmarks near the robot; choose them anew when it has gone on.

        The region holds whatever the sensor has been seen to reach. Lines have no place, so all
        of them are always worked on.
        """
        e, f = self._p.ekf, self.filter
        if e.update == 'plain' or self.model is not POINT:
            return
        if seen is not None and len(seen.z):
            self._reach = max(self._reach, float(np.max(seen.z[:, 0])))
        here = f.x[:2]
        sigma = 3.0 * float(np.sqrt(np.trace(f.P[:2, :2])))
        needed = self._reach + sigma
        region = self._region
        if region is not None and np.hypot(*(here - region)) + needed <= self._radius:
            return
        f.settle()
        self._region = here.copy()
        self._radius = max(e.local_radius, needed) + e.local_margin
        f.choose(np.hypot(*(f.points - here).T) <= self._radius)

    # --- data association ----------------------------------------------------------------------

    def _associate(
        self, z: Array, R: Array, detections: Detections
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Slots of the local landmarks (k,), -1 for none; Status (k,); squared distance (k,)."""
        f, k = self.filter, len(z)
        slots, status = np.full(k, -1, dtype=np.int64), np.full(k, Status.NEW, dtype=np.int64)
        if not len(f.local):
            return slots, status, np.full(k, np.nan)
        h, H_r, H_m = self.model.observe(f.x[:3], f.points)
        nu = self.model.innovation(z[:, None], h[None])
        d2 = mahalanobis2(nu, f.innovation_covs(H_r, H_m)[None] + R[:, None])
        ids = self.ids[f.local]
        if self._joint is not None:
            believed = Believed(f.pose, f.points, ids, f.pose_and_points_cov())
            found = self._joint.associate(detections, believed)
            return found.match, found.status, found.distance2
        same = compatible_ids(detections.ids, ids)
        told = (detections.ids[:, None] == ids[None]) & (ids[None] != ANONYMOUS)
        # an id needs no gate but sense
        gated = np.where(told, np.where(d2 <= self._new_gate, 0.0, np.inf), d2)
        slots = nearest(np.where(same, gated, np.inf), self._gate)
        status[slots >= 0] = Status.USED
        status[(slots < 0) & self._is_known(z, d2, told, detections)] = Status.GATED
        best = np.where(slots >= 0, d2[np.arange(k), np.maximum(slots, 0)], np.nan)
        return slots, status, best

    def _is_known(
        self, z: Array, d2: Array, told: NDArray[np.bool_], detections: Detections
    ) -> NDArray[np.bool_]:
        """(k,): so near to a landmark, though outside of its gate, that it starts no candidate."""
        where = self.model.place(self.filter.x[:3], z)[0]
        gap = np.linalg.norm(where[:, None] - self.filter.points[None], axis=-1)
        blur = self._p.reflector.blur * np.sqrt(np.linalg.eigvalsh(detections.cov)[:, -1])
        near = gap.min(axis=1) < np.maximum(self._p.ekf.min_separation, blur)
        near |= d2.min(axis=1) <= self._new_gate
        # one that tells who it is, is new if nobody has told so before
        anonymous = detections.ids == ANONYMOUS
        out: NDArray[np.bool_] = (near & anonymous) | told.any(axis=1)
        return out

    # --- step 2: re-observed landmarks -------------------------------------------------------

    def _update(
        self, z: Array, R: Array, slots: NDArray[np.int64], detections: Detections
    ) -> None:
        """Each re-observed landmark on its own, linearised where the last one left the state."""
        for k in np.flatnonzero(slots >= 0):
            self.filter.update(int(slots[k]), z[k], R[k])
            number = self.filter.local[slots[k]]
            self.sightings[number] += 1
            if detections.ids[k] != ANONYMOUS:
                self.ids[number] = detections.ids[k]

    # --- step 3: new landmarks -----------------------------------------------------------------

    def _grow(
        self,
        stamp: int,
        z: Array,
        R: Array,
        detections: Detections,
        keys: NDArray[np.int64],
        statuses: NDArray[np.int64],
    ) -> None:
        """Count what is new as candidates; those seen N times enter the state."""
        e = self._p.ekf
        new = np.flatnonzero(statuses == Status.NEW)
        if len(new) and self._mapping:
            ids = detections.ids[new]
            times = self.candidates.see(stamp, z[new], R[new], ids, self._gate)
            for k, n in zip(new, times, strict=True):
                if n >= e.sightings:
                    keys[k] = self.filter.augment(z[k], R[k])
                    self._note(int(detections.ids[k]), int(n), float(detections.diameters[k]))
        self.candidates.drop(stamp, e.sightings, e.candidate_timeout, e.candidate_sigma)
        self.fates.update(Status(s).name for s in statuses)

    def _note(self, id_: int, sightings: int, diameter: float) -> None:
        self.ids = np.append(self.ids, id_)
        self.sightings = np.append(self.sightings, sightings)
        self.diameters = np.append(self.diameters, diameter)

    # --- results ---------------------------------------------------------------------------------

    def _draw(self, observation: Observation) -> None:
        """Keep a scan for the grid where the robot has moved since the last one kept."""
        self._stamps.append(observation.stamp)
        self._poses.append(self.filter.pose)
        if observation.points is None or observation.origin is None:
            return
        pose = self.filter.pose
        if self._drawn:
            last = self._drawn[-1][0]
            moved = np.hypot(*(pose[:2] - last[:2])) >= MAP_TRAVEL
            if not moved and abs(np.sin(0.5 * (pose[2] - last[2]))) < np.sin(0.5 * MAP_TURN):
                return
        self._drawn.append((pose, observation.points, observation.origin))

    def _frame(
        self,
        observation: Observation,
        seen: Measured | None,
        keys: NDArray[np.int64],
        statuses: NDArray[np.int64],
        chi2_sum: float,
        began: float,
    ) -> Frame:
        pose, cov = self.filter.pose, self.filter.pose_cov
        if seen is not None:  # keys and statuses are of what was measured
            observation = dataclasses.replace(observation, detections=seen.detections)
        health = self.health.judge(
            observation.stamp,
            Evidence(),
            odometry=observation.motion.known,
            detections=None if seen is None else len(statuses),
            used=int((statuses == Status.USED).sum()),
            cov=cov,
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
            chi2=chi2_sum,
            wall_ms=(time.perf_counter() - began) * 1e3,
        )

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) in the map frame, as estimated live."""
        return np.array(self._stamps, dtype=np.int64), np.array(self._poses).reshape(-1, 3)

    def reflectors(self) -> Reflectors:
        """All landmarks of the state, in the map frame."""
        self.filter.settle()
        self._region = None
        n = self.filter.num_landmarks
        return Reflectors(
            np.arange(n, dtype=np.int64), self.filter.points.copy(), self.filter.point_covs(),
            self.ids.copy(), self.sightings.copy(), self.diameters.copy(),
        )  # fmt: skip

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The kept scans at the poses of their time, None without any."""
        kept = [d for d in self._drawn if len(d[1])]
        if not kept:
            return None
        poses, points, origins = zip(*kept, strict=True)
        resolution = self._p.back_end.resolution
        return render(np.array(poses), list(points), list(origins), resolution)
