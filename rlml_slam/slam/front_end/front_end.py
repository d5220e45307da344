# SPDX-License-Identifier: Apache-2.0
"""The RLML front end: MAP estimate of the pose of every scan (eq. 1 to 11).

Terms: odometry (:mod:`motion_term`), reflectors (:mod:`reflector_term`), scan (:mod:`scan_term`).
State: the joint Gaussian of pose, submap anchors and reflectors (:mod:`joint_state`). With anchors
and reflectors known exactly, the update is eq. 3 and its covariance eq. 11.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import Correction, ReferencePose
from rlml_slam.estimation.health import HealthInputs, HealthMonitor, ScanEvidence
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.estimation.laser_check import LaserCheck
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.map_localization import MapLocalization
from rlml_slam.slam.front_end.motion_term import MotionTerm
from rlml_slam.slam.front_end.reflector_term import USED, Matches, ReflectorTerm
from rlml_slam.slam.front_end.scan_term import ScanTerm
from rlml_slam.slam.front_end.submaps import Submaps
from rlml_slam.slam.relocalization.carried_robot import CarriedRobot, unknown_way
from rlml_slam.types import Belief, Frame, Health, Observation, Reflectors


class FrontEnd:
    """Estimates the pose of every observation in the local frame, from ``map_start_pose`` on.

    All state is in the terms and in the joint state that they share; results are frozen values.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self.reset(np.array(params.node.map_start_pose), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array) -> None:
        """Drop all state and start at a pose (3,) of the map with covariance (3, 3)."""
        m = self._p.motion
        wheels = (*m.first_scale_errors, m.drift_sigma, 0.0)
        self.state = JointState(pose, cov, m.imu_bias_sigma, m.constant_velocity_sigma, wheels)
        self._motion, self._laser = MotionTerm(self._p), LaserCheck()
        self._reflectors = ReflectorTerm(self._p, self.state)
        self._scans = ScanTerm(self._p, self.state, self._motion)
        self._map = MapLocalization(self._p)
        self._correction, self._carried = Correction(np.zeros(3)), CarriedRobot()
        self.health = HealthMonitor(self._p.health)
        self._jumped, self._is_settled, self._settling = False, True, 0.0  # [s] in settle()

    def process(self, observation: Observation) -> Frame:
        """Pose at the stamp of the observation; never raises for what was measured.

        Reflectors update twice. Before the scan, they correct the odometry, so that the scan
        match starts close to its optimum. After the scan, those detections are associated that
        were ambiguous or outside their gates with the prior; each detection is used once.
        """
        began = self._finish_last_step()
        self._laser.add_motion(observation.stamp, observation.motion)
        observation = self._motion.likeliest(observation, self._scans.fit)
        self._motion.predict(self.state, observation)
        observation, sweep = self._scans.deskew(observation)
        matches = self._reflectors.begin(observation, self._motion.velocity)
        scan = self._update_with_scan(observation, sweep, matches)
        matches = self._reflectors.update(observation, matches)
        contradicted, moved = self._contradicts_map(observation, matches, scan)
        observation = self._reflectors.widen(
            self._motion.corrected(self.state, observation), matches
        )
        matches = self._grow_map(observation, matches, scan, contradicted)
        if moved:  # it maps on, and the graph is to find out where that was
            self._scans.start_new_submaps()
            scan = ScanEvidence(has_scan=scan.has_scan)
            self._reflectors.forget_anonymous()
            self._scans.common.add(self.state.pose, unknown_way(self._p))
            observation = observation.with_noise(unknown_way(self._p))
        health = self._evaluate_health(observation, matches, scan)
        return self._frame(observation, matches, scan, health, contradicted, began)

    def settle(self) -> None:
        """Do the work that the frame did not need; its time counts for the next frame.

        Optional between two calls of :meth:`process`, which does it otherwise.
        """
        began = time.perf_counter()
        self.submaps.settle()
        self._is_settled = True
        self._settling += time.perf_counter() - began

    def _finish_last_step(self) -> float:
        """Settle the last step if needed; the time at which this step began [s]."""
        began, self._settling = time.perf_counter() - self._settling, 0.0
        if not self._is_settled:
            self.submaps.settle()
        self._is_settled = False
        return began

    def _update_with_scan(
        self, observation: Observation, sweep: Sweep, matches: Matches
    ) -> ScanEvidence:
        """Update with the match in the submap, then in the grid of the saved map, if any."""
        maps = self._map.saved is None
        scan = self._scans.update(observation, sweep, matches.agree_with_map, maps)
        self._map.update(self.state, observation, sweep)
        return scan

    def _contradicts_map(
        self, observation: Observation, matches: Matches, scan: ScanEvidence
    ) -> tuple[bool, bool]:
        """Whether scan and reflectors contradict the map, and whether the robot was carried."""
        # an unmatched detection with an id is no contradiction here: the back end resolves it
        resolved = matches.num_unmatched_ids(observation.detections)
        fits = scan.used and scan.open_direction is None and not self._map.grid_match.refutes
        kidnapping, stamp = self._scans.kidnapping, observation.stamp
        contradicted = kidnapping.holds(stamp)
        if scan.has_scan or len(matches.status):  # a sensor that sees nothing changes nothing
            contradicted = kidnapping.check(
                stamp, scan.misfit, fits, len(matches.status) - resolved,
                matches.num_used, bool(self.tracks.surveyed.any()),
            )  # fmt: skip
        self._carried.follow(observation, scan, kidnapping.since)
        lasts = kidnapping.has_lasted(stamp, self._p.health.new_session_time)
        if lasts and self._map.saved is None:
            if not self._carried.leapt:
                self._scans.start_new_submaps()
            return self._carried.leapt, self._carried.leapt
        return contradicted, False

    def _grow_map(
        self, observation: Observation, matches: Matches, scan: ScanEvidence, contradicted: bool
    ) -> Matches:
        """Add new reflectors and insert the scan into the submaps, unless they contradict them."""
        matches = self._reflectors.grow(observation, matches, contradicted)
        broken = self._scans.insert(observation, scan, contradicted and scan.misfit)
        self._map.doubt(broken and not matches.agree_with_map)
        return matches

    def _evaluate_health(
        self, observation: Observation, matches: Matches, scan: ScanEvidence
    ) -> Health:
        stamp, confirmation = observation.stamp, self._map.confirmation
        confirmation.check(
            stamp, math.hypot(*observation.motion.delta[:2].tolist()), len(matches.status),
            matches.num_used, matches.agree_with_map, self._map.grid_match,
        )  # fmt: skip
        expected, seen = self._reflectors.expected_and_seen(observation, matches)
        lasts = self._scans.kidnapping.has_lasted(stamp, self._p.health.lost_time)
        pose, cov = self.in_map(*self.local_belief)
        return self.health.evaluate(
            stamp,
            HealthInputs(
                scan=scan,
                has_odometry=observation.motion.known or not self._p.node.use_odom,
                detections=self._map.num_comparable(observation.detections),
                matched=matches.num_used,
                cov_map=cov,
                unconfirmed=confirmation.reason,
                is_lost=confirmation.is_lost,
                contradicted=lasts and not confirmation.is_pending,
                expected=expected,
                seen=seen,
                maps=self._map.saved is None,
                position=pose[:2],
                mounting=self._laser.fault(self.state.pose),
            ),
        )

    def _frame(
        self, observation: Observation, matches: Matches, scan: ScanEvidence, health: Health,
        contradicted: bool, began: float,
    ) -> Frame:  # fmt: skip
        pose, cov = self.local_belief
        late = self._motion.stamp_error_cov(float(self.state.x[2]), observation.stamp_sigma)
        T_map_base, cov_map = self.in_map(pose, cov + late)
        jumped, self._jumped = self._jumped, False
        return Frame(
            observation.stamp, observation, pose, cov, T_map_base, cov_map,
            matches.keys, matches.status, health,
            scan_score=scan.score, scan_used=scan.used, iterations=scan.iterations,
            chi2=float(matches.distance2[matches.status == USED].sum()),
            wall_ms=(time.perf_counter() - began) * 1e3,
            unconfirmed=contradicted or self._map.confirmation.is_pending,
            jumped=jumped,
        )  # fmt: skip

    def use_map(self, reflectors: Reflectors, grid: OccupancyGrid | None = None) -> None:
        """Localize in a saved map of reflectors and grid (map frame), which does not grow.

        The estimates of its reflectors are updated within their covariances. A start pose without
        covariance gets ``map_start_sigma``. The pose is unconfirmed until scan or reflectors
        match the map.
        """
        if not self.state.pose_cov.any():
            self.state.widen(np.diag(np.array(self._p.node.map_start_sigma) ** 2))
        self._map.use_map(reflectors, grid)
        self._reflectors.use_map(reflectors)

    def relocate(self, T_map_base: Array, cov: Array) -> None:
        """Continue at another pose (3,), (3, 3) of the map, after relocalization.

        Reflectors keep their positions; the submaps were built elsewhere and start again.
        """
        T_map_local, T_local_map = self.T_map_local, se2.inverse(self.T_map_local)
        pose = se2.compose(T_local_map, T_map_base)
        cov = se2.rotate_cov(cov, T_local_map[2])
        saved = self._map.saved
        if saved is not None:
            before, motion = self.state, self._motion
            self.reset(pose, cov)
            self.use_map(saved.reflectors, saved.grid)
            self.state.take_systematic_errors(before)
            self._motion.stamp, self._motion.has_lidar = motion.stamp, motion.has_lidar
        else:
            self.state.place(pose, cov)
            self._scans.common.clear()
            self._scans.start_new_submaps()
            self._motion.forget_velocity()
            self._reflectors.forget_slip()
        # the reference keyframe of the graph is where the robot was before
        self._correction = Correction(T_map_local)
        self._jumped = True

    def correct(self, T_map_local: Array, reference: ReferencePose | None = None) -> None:
        """Apply the newest correction by the back end; without a ``reference``, the last stays."""
        reference = self._correction.reference if reference is None else reference
        self._correction = Correction(np.array(T_map_local, dtype=np.float64), reference)

    def contradicts(self, belief: Belief) -> bool:
        """Whether the reflectors of the back end are outside the gates of this estimate."""
        return self._reflectors.contradicts(belief, self.T_map_local)

    def adopt(self, belief: Belief) -> None:
        """Replace reflectors, and their joint covariance with the pose, by those of the back end.

        The local pose stays; candidates that the back end does not have are dropped. Call it
        for the frame of the newest keyframe, after :meth:`correct`.
        """
        self._reflectors.adopt(belief, self.T_map_local, self.submaps.bias)
        self._scans.common.clear()  # the state has the covariance of the graph now
        self._correction = Correction(self.T_map_local)

    def forget(self, keys: Iterable[int]) -> None:
        """Drop reflectors that the back end has removed."""
        self._reflectors.forget(keys)

    def in_map(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """Pose (3,) and covariance (3, 3) of the local frame, both in the map frame."""
        return self._correction.apply(pose, cov)

    @property
    def T_map_local(self) -> Array:
        """Pose (3,) of the local frame in the map, by the last correction."""
        return self._correction.T_map_local

    @property
    def local_belief(self) -> tuple[Array, Array]:
        """Pose (3,) and covariance (3, 3) in the local frame."""
        return self._scans.common.belief(self.state.pose, self.state.pose_cov)

    @property
    def tracks(self) -> LandmarkTracks:
        """Identities of the reflectors of the state."""
        return self._reflectors.tracks

    @property
    def submaps(self) -> Submaps:
        """Submaps that scans are matched against."""
        return self._scans.submaps

    @property
    def newest(self) -> int | None:
        """Stamp of the newest observation, None before the first."""
        return self._motion.stamp

    def reflectors(self) -> Reflectors:
        """The confirmed reflectors in the map frame."""
        return self._reflectors.confirmed(self.T_map_local)
