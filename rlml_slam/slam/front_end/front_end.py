# SPDX-License-Identifier: Apache-2.0
"""The RLML front end: the MAP pose of every scan over odometry, reflectors and submap (eq. 1-11).

The state is the joint Gaussian of pose, submap anchors and reflectors (:mod:`joint_state`); with
the latter two known exactly, the update below is eq. 3 and its covariance eq. 11 to the letter.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import Correction, ReferencePose
from rlml_slam.estimation.health import Evidence, HealthMonitor
from rlml_slam.estimation.kidnapping_detection import KidnappingDetection
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.constant_velocity import ConstantVelocity
from rlml_slam.slam.front_end.grid_localization import Fix, GridLocalizer
from rlml_slam.slam.front_end.joint_state import STANDING, SYSTEMATIC, JointState
from rlml_slam.slam.front_end.map_confirmation import START_SIGMA, MapConfirmation
from rlml_slam.slam.front_end.odometry_scale import went_on
from rlml_slam.slam.front_end.reflector_term import USED, Matched, ReflectorTerm
from rlml_slam.slam.front_end.scan_term import ScanTerm
from rlml_slam.slam.front_end.submaps import Submaps
from rlml_slam.slam.front_end.velocity_deskew import Sweep
from rlml_slam.slam.relocalization.scan_relocalization import is_mapped
from rlml_slam.types import (
    ANONYMOUS,
    Belief,
    Frame,
    Health,
    Observation,
    Reflectors,
)

BURST = 50_000_000  # [ns] between two scans that tell a velocity


class FrontEnd:
    """Localises every observation in the local frame, which starts at ``map_start_pose``.

    ``process`` is the system: same object for the live node, the replay and the tests. All state
    is here and in its two terms; results are frozen values.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self.reset(np.array(params.node.map_start_pose), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array) -> None:
        """Forget everything and start at a pose (3,) of the map with covariance (3, 3)."""
        m = self._p.motion
        self.state = JointState(
            pose, cov, m.imu_bias_sigma, m.constant_velocity_sigma, m.scale_error_sigma
        )
        self._reflectors = ReflectorTerm(self._p, self.state)
        self._scans = ScanTerm(self._p, self.state)
        self.health = HealthMonitor(self._p.health)
        self._grid: GridLocalizer | None = None
        self._fix = Fix(math.nan)
        self._jumped = False
        self._correction = Correction(np.zeros(3))
        self._velocity = np.zeros(3)
        self._since: tuple[int, Array] | None = None
        self._coasting = ConstantVelocity(self._p.motion)
        self._map: SavedMap | None = None
        self.confirmation = MapConfirmation(self._p)
        self._last_stamp: int | None = None
        self._settling = 0.0  # [s] since the last frame
        self._is_settled = True

    def use_map(self, reflectors: Reflectors, grid: OccupancyGrid | None = None) -> None:
        """Localise against given reflectors and grid (map frame); nothing is added to them.

        The estimate of a reflector moves with its detections, within the covariance given for it.
        A start pose that is only assumed, with no covariance, is as good as a person's guess; and
        it stays unconfirmed until what is seen agrees with the map.
        """
        self._map = SavedMap(reflectors)
        self.use_grid(grid)
        if not self.state.pose_cov.any():
            self.state.widen(np.diag(START_SIGMA**2))
        self.confirmation.begin()
        self._reflectors.use_map(reflectors)

    def use_grid(self, grid: OccupancyGrid | None) -> None:
        """Localise against a grid as well, or no longer."""
        assert self._map is not None
        self._map = replace(self._map, grid=grid)
        self._grid = None
        if grid is not None and is_mapped(grid):
            self._grid = GridLocalizer(grid, self._p)

    def relocate(self, T_map_base: Array, cov: Array) -> None:
        """Go on from another place (3,), (3, 3) of the map.

        A submap begun where the robot was lies elsewhere; reflectors stay where they are.
        """
        T_local_map = se2.inverse(self.T_map_local)
        pose, R = se2.compose(T_local_map, T_map_base), np.eye(3)
        R[:2, :2] = se2.rotation(T_local_map[2])
        cov = R @ cov @ R.T
        if self._map is not None:
            errors, cov_errors = self.state.x[SYSTEMATIC], self.state.P[SYSTEMATIC, SYSTEMATIC]
            T_map_local, last = self.T_map_local, self._last_stamp
            known = self._map
            self.reset(pose, cov)
            self.use_map(known.reflectors, known.grid)
            self.state.x[SYSTEMATIC], self.state.P[SYSTEMATIC, SYSTEMATIC] = errors, cov_errors
            self._last_stamp = last
        else:
            self.state.place(pose, cov)
            self._scans.begin_anew()
            self._since, self._velocity = None, np.zeros(3)
            T_map_local = self.T_map_local
        # what the graph knows is of where the robot was
        self._correction = Correction(T_map_local)
        self._jumped = True

    def correct(self, T_map_local: Array, reference: ReferencePose | None = None) -> None:
        """Apply the newest correction of the local frame by the back end.

        Without a ``reference``, that of the last correction stays in use.
        """
        reference = self._correction.reference if reference is None else reference
        self._correction = Correction(np.array(T_map_local, dtype=np.float64), reference)

    def in_map(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (3,) of the local frame and its covariance (3, 3), both in the map frame."""
        return self._correction.apply(pose, cov)

    @property
    def T_map_local(self) -> Array:
        """The local frame's pose (3,) in the map, as the back end corrected it last."""
        return self._correction.T_map_local

    @property
    def tracks(self) -> LandmarkTracks:
        """Whose the landmarks of the state are."""
        return self._reflectors.tracks

    @property
    def submaps(self) -> Submaps:
        """What scans are matched against."""
        return self._scans.submaps

    @property
    def kidnapping(self) -> KidnappingDetection:
        """Whether what is seen contradicts the map."""
        return self._scans.kidnapping

    @property
    def newest(self) -> int | None:
        """Stamp of the newest observation, None before the first."""
        return self._last_stamp

    def contradicts(self, belief: Belief) -> bool:
        """Whether the back end's reflectors are not where this end's estimate has them."""
        return self._reflectors.contradicts(belief, self.T_map_local)

    def adopt(self, belief: Belief) -> None:
        """Go on from the back end's reflectors, and its covariance of them and of the pose.

        The local pose stays as it is; candidates that the back end does not know start anew.
        Call it for the frame that became the newest keyframe, after :meth:`correct`.
        """
        self._reflectors.adopt(belief, self.T_map_local, self.submaps.bias)
        # the state has the covariance of the graph now
        self._correction = Correction(self.T_map_local)

    def forget(self, keys: Iterable[int]) -> None:
        """Drop reflectors that the back end knows to be gone."""
        self._reflectors.forget(keys)

    def process(self, observation: Observation) -> Frame:
        """The pose at the observation's stamp; never raises for what was measured.

        What the frame can do without is left for :meth:`settle`, or for the next call.
        """
        began, self._settling = time.perf_counter() - self._settling, 0.0
        if not self._is_settled:
            self.submaps.settle()
        self._is_settled = False
        coasts = self._predict(observation)
        sweep = Sweep()
        if coasts:
            observation, sweep = self._scans.deskewed(observation)
        self._reflectors.follow(observation.detections)
        matched = Matched.none(observation.detections)
        self._reflectors.use(observation, matched)
        evidence = self._scans.use(observation, sweep, matched.agrees)
        self._use_grid(observation)
        self._reflectors.use(observation, matched)
        doubtful = self._is_doubtful(observation, matched, evidence)
        if coasts:
            motion = self._coasting.found(self.state, observation.motion)
        else:
            motion = self.state.corrected(observation.motion)
        observation = replace(observation, motion=motion)
        observation = self._reflectors.with_spread(observation, matched)
        self._reflectors.grow(observation, matched, doubtful)
        self._scans.insert(observation, evidence, doubtful and evidence.misfit)
        self._remember_velocity(observation.stamp)
        moved = observation.motion.delta
        self.confirmation.judge(
            observation.stamp, math.hypot(moved[0], moved[1]), len(matched.status),
            matched.num_used, matched.agrees, self._fix,
        )  # fmt: skip
        health = self._judge(observation, matched, evidence)
        frame = self._frame(observation, matched, evidence, health, doubtful, began)
        self._jumped = False
        return frame

    def settle(self) -> None:
        """Do what could wait until the frame was on its way; it counts as time of the next one."""
        began = time.perf_counter()
        self.submaps.settle()
        self._is_settled = True
        self._settling += time.perf_counter() - began

    # --- prior -----------------------------------------------------------------------------

    def _predict(self, observation: Observation) -> bool:
        """Move the pose as odometry says; whether the robot has none and goes on as it went."""
        stamp, last = observation.stamp, self._last_stamp
        self._last_stamp = stamp
        self._scans.has_odometry |= observation.odom_pose is not None
        dt = 0.0 if last is None else (stamp - last) * 1e-9
        coasts = not self._scans.has_odometry and last is not None
        if coasts:
            self._coasting.predict(self.state, dt, observation.motion)
        else:
            p, motion = self._p.motion, observation.motion
            went = went_on(self._velocity, dt, p) if motion.known else STANDING
            kept = math.exp(-dt / p.scale_error_time)
            self.state.predict(motion, p.imu_bias_walk**2 * dt, kept, went)
        return coasts

    def _remember_velocity(self, stamp: int) -> None:
        """Velocity over BURST at least: scans of one burst are too close to divide by."""
        pose, since = self.state.pose, self._since
        if since is None:
            self._since = (stamp, pose)
        elif stamp - since[0] >= BURST:
            dt = (stamp - since[0]) * 1e-9
            self._velocity = se2.log(se2.between(since[1], pose)) / dt
            self._since = (stamp, pose)

    # --- grid of a saved map -----------------------------------------------------------------

    def _use_grid(self, observation: Observation) -> None:
        """Match against the grid of a saved map, where there is one."""
        points = observation.points
        if self._grid is None or points is None or len(points) < self._p.scan_match.min_points:
            return
        if self._grid.is_due(self.state.pose):
            self._fix = self._grid.fix(self.state, points)

    # --- result --------------------------------------------------------------------------------

    def _is_doubtful(self, observation: Observation, matched: Matched, evidence: Evidence) -> bool:
        """Whether the frame contradicts the map; while mapping, a new place does not forever."""
        d = observation.detections
        # one that tells who it is tells the back end more than that it does not fit here
        told = 0 if d is None else int(((d.ids != ANONYMOUS) & matched.open).sum())
        contradicted = self.kidnapping.judge(
            observation.stamp,
            evidence.misfit,
            evidence.used and evidence.weak is None,
            len(matched.status) - told,
            matched.num_used,
            bool(self.tracks.surveyed.any()),
        )
        p = self._p.health
        if self._map is None and self.kidnapping.lasts(observation.stamp, p.new_session_time):
            self._scans.begin_anew()
            return False
        return contradicted

    def _judge(self, observation: Observation, matched: Matched, evidence: Evidence) -> Health:
        due = self._reflectors.due(observation, matched)
        used = matched.keys[matched.status == USED]
        return self.health.judge(
            observation.stamp,
            evidence,
            odometry=observation.motion.known or not self._p.node.use_odom,
            detections=None if observation.detections is None else len(observation.detections),
            used=matched.num_used,
            cov=self.in_map(self.state.pose, self.state.pose_cov)[1],
            unconfirmed=self.confirmation.reason,
            lost=self.confirmation.is_lost,
            contradicted=self._scans.lasts(observation.stamp) and not self.confirmation.is_pending,
            expected=int(due.sum()),
            seen=len(set(self.tracks.keys[due].tolist()).intersection(used.tolist())),
        )

    def _frame(
        self,
        observation: Observation,
        matched: Matched,
        evidence: Evidence,
        health: Health,
        doubtful: bool,
        began: float,
    ) -> Frame:
        pose, cov = self.state.pose, self.state.pose_cov
        T_map_base, cov_map = self.in_map(pose, cov + self.late(observation.stamp_sigma))
        used = matched.status == USED
        return Frame(
            stamp=observation.stamp,
            observation=observation,
            T_local_base=pose,
            cov_local=cov,
            T_map_base=T_map_base,
            cov_map=cov_map,
            landmarks=matched.keys,
            statuses=matched.status,
            health=health,
            scan_score=evidence.score,
            scan_used=evidence.used,
            chi2=float(matched.distance2[used].sum()),
            iterations=evidence.iterations,
            wall_ms=(time.perf_counter() - began) * 1e3,
            unconfirmed=doubtful or self.confirmation.is_pending,
            jumped=self._jumped,
        )

    def late(self, sigma: float) -> Array:
        """Covariance (3, 3) of how far the robot goes in the error ``sigma`` [s] of a stamp.

        It is published alone: one stamp's error is nearly that of the next, and of the map's.
        """
        if sigma == 0.0:
            return np.zeros((3, 3))
        R = np.eye(3)
        R[:2, :2] = se2.rotation(self.state.pose[2])
        gone = R @ self._velocity * sigma
        return np.outer(gone, gone)

    def reflectors(self) -> Reflectors:
        """The confirmed reflectors in the map frame."""
        return self._reflectors.confirmed(self.T_map_local)
