# SPDX-License-Identifier: Apache-2.0
"""The scan term: match of a scan with the submap, and its update of the state (e_s of eq. 2)."""

from __future__ import annotations

import copy
import math

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.common_error import CommonError
from rlml_slam.estimation.health import ScanEvidence, eigenvalues_2x2, open_direction
from rlml_slam.estimation.kidnapping_detection import KidnappingDetection
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.scan_match import UNKNOWN, ScanMatchResult, match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.velocity_deskew import Sweep, deskewed
from rlml_slam.slam.front_end.degeneracy import Degeneracy
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.motion_term import MotionTerm
from rlml_slam.slam.front_end.scan_update import Found, fuse, prior_of, relative
from rlml_slam.slam.front_end.submaps import Submaps
from rlml_slam.slam.relocalization.local_recovery import (
    AS_USUAL,
    TURN,
    match_after_gap,
    may_have_left,
    recover_locally,
)
from rlml_slam.types import Observation

FAR = 3.0  # [sigma] half width of a search without odometry
# [m] 1 sigma in its submap of a robot without odometry, beyond which it starts another submap
MAX_SIGMA_IN_SUBMAP = 0.5
NEAR = 0.3  # [m] of a reflector, a detection may be one of it
DOUBT = 0.02  # by which a fit is better that is where the motion led
MIN_KNOWN = 0.33  # share of end points in known cells below which a scan cannot contradict


class ScanTerm:
    """Submaps of a joint state, and detection of scans that contradict them.

    ``common`` is the error of the newest submaps that the state does not have.

    ``motion`` says whether the prior comes from odometry or from the constant-velocity model.
    """

    def __init__(self, params: Parameters, state: JointState, motion: MotionTerm) -> None:
        self._p = params
        self._state = state
        self._motion = motion
        self.common, self._maps = CommonError(), True
        self.start_new_submaps()

    def start_new_submaps(self) -> None:
        """Drop the submaps: the robot was moved, or is somewhere else."""
        self.submaps = Submaps(self._p.submap)
        self.kidnapping = KidnappingDetection(self._p.health)
        self._degeneracy = Degeneracy()
        self._last_fit = 0  # stamp of the last scan that was matched

    def deskew(self, observation: Observation) -> tuple[Observation, Sweep]:
        """Deskew a scan by the velocity of the state, if there is no odometry.

        Twice: by the predicted velocity, then by that after a match of the first result.
        """
        if not self._motion.is_constant_velocity:
            return observation, self._motion.sweep
        p, max_range = self._p.scan_match, self._p.submap.max_laser_range
        first, sweep = deskewed(observation, self._state.velocity, max_range)
        submap = self.submaps.target
        if not sweep.half.any() or submap is None or first.points is None:
            return first, sweep
        if len(first.points) < p.min_points:
            return first, sweep
        points = voxel_filter.thin(first.points, p.voxel_size, p.max_points)
        state = copy.deepcopy(self._state)
        prior, strength = self._prior(sweep)
        found = match(submap, points, prior, strength, p, searched=False)
        if found.score < max(p.search_threshold, AS_USUAL * self.kidnapping.usual):
            return first, sweep
        self._fuse(state, found, self._information(submap, points, found), sweep)
        return deskewed(observation, state.velocity, max_range)

    def fit(self, observation: Observation) -> tuple[float, Array] | None:
        """How well scan and reflectors fit after a motion, 0 to 1, and the pose (3,) there.

        None without any.

        A motion is searched for as it will be: a fast turn of the wheels is uncertain. A scan that
        contradicts the map speaks for no motion, however little of it fits by chance.
        """
        state, p = copy.deepcopy(self._state), self._p.scan_match
        state.predict(observation.motion, 0.0)
        submap, detections, fits = self.submaps.target, observation.detections, []
        points = observation.points
        if submap is not None and points is not None and len(points) >= p.min_points:
            points = voxel_filter.thin(points, p.voxel_size, p.max_points)
            nothing = Sweep()
            floor2 = np.array(p.variance_floor)
            prior = prior_of(state.x, state.P, floor2, nothing.half, nothing.velocity)
            found = self._match(submap, points, *prior)
            contradicted = self._contradicts(submap, points, found)
            fits.append(0.0 if contradicted else found.score + DOUBT * found.prior_weight)
            state.x[:3] = se2.compose(state.anchor(0), found.pose)
        landmarks = state.landmarks()
        if detections is not None and len(detections) and len(landmarks):
            at = se2.transform(state.pose, detections.points)
            away = np.linalg.norm(at[:, None] - landmarks[None], axis=-1).min(axis=1)
            fits.append(float(np.mean(away < NEAR)))
        return (float(np.mean(fits)), state.pose) if fits else None

    def update(
        self, observation: Observation, sweep: Sweep, reflectors_agree: bool, maps: bool
    ) -> ScanEvidence:
        """Match the scan with the submap and update the state (e_s of eq. 2).

        Where a robot that ``maps`` drove on and saw nothing, a scan has to fit as usual, where
        odometry led or at one place only; else submaps start there, with the motion's covariance.
        """
        p, submap, self._maps = self._p.scan_match, self.submaps.target, maps
        if observation.points is None:
            return ScanEvidence(has_scan=False)
        if submap is None or len(observation.points) < p.min_points:
            return ScanEvidence(has_scan=submap is None)
        points = voxel_filter.thin(observation.points, p.voxel_size, p.max_points)
        prior, strength = self._prior(sweep)
        found, usual = self._match(submap, points, prior, strength), self.kidnapping.usual
        as_expected = found.score >= AS_USUAL * usual and found.prior_weight >= 0.5
        left = may_have_left(observation.motion, self._motion.interval, self._p)
        if maps and left and not (as_expected or reflectors_agree):
            only = match_after_gap(submap, points, prior, strength, usual, self._p)
            if only is None:
                self._begin_elsewhere()
                return ScanEvidence(has_scan=False)
            found = only
        misfit = self._contradicts(submap, points, found)
        lost = self.kidnapping.has_lasted(observation.stamp, self._p.health.lost_time)
        if misfit and not reflectors_agree and not lost:
            turn = TURN if self._motion.has_odometry else math.pi
            found = recover_locally(submap, points, prior, usual, self._p, turn) or found
            misfit = self._contradicts(submap, points, found)
        if found.score < p.min_score or (misfit and not reflectors_agree):
            return ScanEvidence(has_scan=True, misfit=misfit, score=found.score)
        self.kidnapping.learn(found.score)
        information = self._information(submap, points, found)
        self._fuse(self._state, found, information, sweep)
        heading = float(self._state.anchor(0)[2])
        return ScanEvidence(
            has_scan=True,
            used=True,
            misfit=misfit,
            score=found.score,
            open_direction=open_direction(information, heading, self._p.health.degeneracy_sigma),
            iterations=found.iterations,
            submap=submap if self._motion.has_odometry else None,
            cov_submap=relative(self._state.x, self._state.P)[1],
        )

    def _begin_elsewhere(self) -> None:
        """Start new submaps, which nothing but the motion ties to the old ones.

        Unless reflectors do, the error of the motion is common to all that comes. With any in the
        state, be it far away or seen once, it stays there.
        """
        self.submaps.start_again()
        if not self._has_reflectors:
            self.common.add(self._state.pose, self._state.pose_cov)
            self._state.P[:3, :] = self._state.P[:, :3] = 0.0

    @property
    def _has_reflectors(self) -> bool:
        return bool(self._state.num_landmarks or self._state.extra)

    def _match(
        self, submap: Submap, points: Array, prior: Array, strength: Array
    ) -> ScanMatchResult:
        """The best match: at the prior, then in wider and wider windows while it fits badly."""
        p, has_odometry = self._p.scan_match, self._motion.has_odometry
        usual = AS_USUAL * self.kidnapping.usual
        if has_odometry:
            found = match(submap, points, prior, strength, p, searched=False)
        else:
            found = self._match_in_window(submap, points, prior, strength, p.search_window)
        # the prior of the constant-velocity model is weak: a bad fit is probably a wrong optimum
        threshold = p.search_threshold if has_odometry else max(p.search_threshold, usual)
        if found.score < threshold or found.prior_weight < 0.5:
            searched = match(submap, points, prior, strength, p)
            found = searched if searched.score > found.score else found
        if (has_odometry and found.score < usual) and (
            found.prior_weight < 0.5 or self._fits_badly(submap, points, found)
        ):
            # next to its true pose, where a wrong stamp leads, a scan fits, but worse than usual
            searched = self._match_in_window(submap, points, prior, strength, p.wide_window)
            found = searched if searched.score >= usual else found
        return found

    def _match_in_window(
        self, submap: Submap, points: Array, prior: Array, strength: Array, half_width: float
    ) -> ScanMatchResult:
        """Match with a search of ``half_width`` [m], or FAR sigmas of the prior if wider."""
        p = self._p.scan_match
        cov: Array = np.asarray(np.linalg.inv(strength), dtype=np.float64)
        reach = FAR * math.sqrt(eigenvalues_2x2(cov[:2, :2])[1])
        turn = min(FAR * math.sqrt(cov[2, 2]), p.wide_angle)
        window = (min(max(reach, half_width), p.wide_window), turn)
        # any error of odometry is inside this window
        usual = 0.0 if self._motion.has_odometry else self.kidnapping.usual
        return match(submap, points, prior, strength, p, window=window, usual=usual)

    def _prior(self, sweep: Sweep) -> tuple[Array, Array]:
        """Predicted pose in the submap (3,), and its information (3, 3)."""
        floor2 = np.array(self._p.scan_match.variance_floor)
        return prior_of(self._state.x, self._state.P, floor2, sweep.half, sweep.velocity)

    def _information(self, submap: Submap, points: Array, found: ScanMatchResult) -> Array:
        """Information (3, 3) of a match, zero along a degenerate direction."""
        alone = not self._motion.has_odometry
        p = self._p.scan_match
        information = scan_information.information(submap, points, found.pose, p, alone)
        return self._degeneracy.cleared(information, float(self._state.anchor(0)[2]))

    def _fuse(
        self, state: JointState, found: ScanMatchResult, information: Array, sweep: Sweep
    ) -> None:
        """Update a state with a match.

        The constant-velocity model is a weaker prior than odometry: its gate is per component,
        and the pull of the prior on the match is compensated.
        """
        gate, pull = self._p.scan_match.prior_robust_scale, np.zeros(3)
        if not self._motion.has_odometry:
            gate, pull = gate / math.sqrt(3.0), found.pull
        before = state.x.copy()
        match = Found(found.pose, information, pull, found.information)
        fuse(state.x, state.P, match, gate, sweep.half, sweep.velocity)
        state.turn_with_anchor(before)

    def _contradicts(self, submap: Submap, points: Array, found: ScanMatchResult) -> bool:
        """Whether a scan fits far worse than usual, and not because it sees unmapped space."""
        is_misfit = self.kidnapping.is_misfit(found.score, submap.insertions)
        return is_misfit and self._fits_badly(submap, points, found)

    def _fits_badly(self, submap: Submap, points: Array, found: ScanMatchResult) -> bool:
        """Whether what a scan sees of mapped space, if it is enough, fits worse than usual."""
        known = submap.knows(se2.transform(found.pose, points))
        least = AS_USUAL * self.kidnapping.usual
        return known < MIN_KNOWN or found.score - (1.0 - known) * UNKNOWN < known * least

    def insert(self, observation: Observation, evidence: ScanEvidence, contradicts: bool) -> bool:
        """Insert the scan into the submaps; a new submap clones the pose as its anchor.

        A single scan without a match is more likely a bad scan (a wrong stamp) than a new place,
        and would disturb the next matches: it is inserted only if none matches for
        ``input_timeout``. A scan that ``contradicts`` the submap would hide that the robot is
        lost. Returns whether the way of the robot is broken: the scan fits none before it.
        """
        if observation.points is None or observation.origin is None or contradicts:
            return False
        if len(observation.points) < self._p.scan_match.min_points:
            return False
        fits = evidence.used or self.submaps.target is None
        if fits:
            self._last_fit = observation.stamp
        elif observation.stamp - self._last_fit < self._p.health.input_timeout * 1e9:
            return False
        if evidence.used and not self._motion.has_odometry and self._is_uncertain_in_submap():
            self.submaps.start_again()
        # a saved map measures the heading, as reflectors do
        common = self.common if self._maps and not self._has_reflectors else None
        inserted = self.submaps.insert(self._state, observation.points, observation.origin, common)
        return inserted and not fits

    def _is_uncertain_in_submap(self) -> bool:
        """Whether the position in the submap is too uncertain to insert scans.

        Then a post in view may match any post of the submap, and a scan inserted at a wrong pose
        would destroy it. In a submap that starts here, the next scans measure the motion, while
        its anchor keeps the uncertainty.
        """
        _, cov = relative(self._state.x, self._state.P)
        return eigenvalues_2x2(cov[:2, :2])[1] > MAX_SIGMA_IN_SUBMAP**2
