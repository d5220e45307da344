# SPDX-License-Identifier: Apache-2.0
"""The scan term: where the scan fits the submap, and what that says of the pose (e_s of eq. 2)."""

from __future__ import annotations

import copy
import math

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.health import Evidence, ends_of, weak_direction
from rlml_slam.estimation.kidnapping_detection import KidnappingDetection
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.scan_match import UNKNOWN, ScanMatchResult, match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.degeneracy import Degeneracy
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.scan_update import fuse, prior_of, relative
from rlml_slam.slam.front_end.submaps import Submaps
from rlml_slam.slam.front_end.velocity_deskew import Sweep, deskewed
from rlml_slam.slam.relocalization.local_recovery import AS_USUAL, TURN, recover_locally
from rlml_slam.types import Observation

FAR = 3.0  # [sigma] a search without odometry reaches
LOOSE = 0.5  # [m] 1 sigma in its submap of a robot without odometry, for which it begins another
KNOWN = 0.33  # share of a scan's end points that tells whether it is of the submap


class ScanTerm:
    """The submaps of a joint state, and the ``doubt`` whether its scans are of them.

    ``has_odometry``: whether anything but the robot's last speed leads to where it is.
    """

    def __init__(self, params: Parameters, state: JointState) -> None:
        self._p = params
        self._state = state
        self.has_odometry = False
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget the submaps: the robot is somewhere else."""
        self.submaps = Submaps(self._p.submap)
        self.kidnapping = KidnappingDetection(self._p.health)
        self._open = Degeneracy()
        self._last_fit = 0

    def deskewed(self, observation: Observation) -> tuple[Observation, Sweep]:
        """The sweep at its stamp by the robot's own velocity: as it was, then as this tells it."""
        p, reach = self._p.scan_match, self._p.submap.max_laser_range
        first, sweep = deskewed(observation, self._state.velocity, reach)
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
        return deskewed(observation, state.velocity, reach)

    def _prior(self, sweep: Sweep) -> tuple[Array, Array]:
        """Where a match is expected in the submap (3,), and its information (3, 3)."""
        floor2 = np.array(self._p.scan_match.variance_floor)
        return prior_of(self._state.x, self._state.P, floor2, sweep.half, sweep.velocity)

    def _information(self, submap: Submap, points: Array, found: ScanMatchResult) -> Array:
        """What a match is worth (3, 3)."""
        alone = not self.has_odometry
        p = self._p.scan_match
        information = scan_information.information(submap, points, found.pose, p, alone)
        return self._open.cleared(information, float(self._state.anchor(0)[2]))

    def _fuse(
        self, state: JointState, found: ScanMatchResult, information: Array, sweep: Sweep
    ) -> None:
        """Update a state with a match.

        A speed is less sure than odometry: what it leads wrong by must not make a new one, and
        what it holds the match back by is made up for.
        """
        gate, pull = self._p.scan_match.prior_robust_scale, np.zeros(3)
        if not self.has_odometry:
            gate, pull = gate / math.sqrt(3.0), found.pull
        fuse(
            state.x, state.P, found.pose, information, gate, pull, found.information,
            sweep.half, sweep.velocity,
        )  # fmt: skip

    def _matched_freely(
        self, submap: Submap, points: Array, prior: Array, strength: Array, least: float
    ) -> ScanMatchResult:
        """The match where it may be off by ``least`` [m], or by as much as the prior tells."""
        p = self._p.scan_match
        spread: Array = np.asarray(np.linalg.inv(strength), dtype=np.float64)
        reach = FAR * math.sqrt(ends_of(spread[:2, :2])[1])
        turn = min(FAR * math.sqrt(spread[2, 2]), p.wide_angle)
        window = (min(max(reach, least), p.wide_window), turn)
        # all that odometry may be wrong by is in this window
        usual = 0.0 if self.has_odometry else self.kidnapping.usual
        return match(submap, points, prior, strength, p, window=window, usual=usual)

    def _misfits(self, submap: Submap, points: Array, found: ScanMatchResult) -> bool:
        """Whether a scan fits far worse than usual, and not because it sees what is new.

        What ends where nothing is known yet contradicts nothing; the rest has to fit as usual.
        """
        if not self.kidnapping.misfits(found.score, submap.insertions):
            return False
        known = submap.knows(se2.transform(found.pose, points))
        least = AS_USUAL * self.kidnapping.usual
        return known < KNOWN or found.score - (1.0 - known) * UNKNOWN < known * least

    def use(self, observation: Observation, sweep: Sweep, agrees: bool) -> Evidence:
        """Match against the submap and update with the scan term (e_s of eq. 2)."""
        p = self._p.scan_match
        submap = self.submaps.target
        if observation.points is None:
            return Evidence(scan=False)
        if submap is None or len(observation.points) < p.min_points:
            return Evidence(scan=submap is None, beams=len(observation.points))
        points = voxel_filter.thin(observation.points, p.voxel_size, p.max_points)
        prior, strength = self._prior(sweep)
        if self.has_odometry:
            found = match(submap, points, prior, strength, p, searched=False)
        else:
            found = self._matched_freely(submap, points, prior, strength, p.search_window)
        usual = AS_USUAL * self.kidnapping.usual
        # where nothing but the speed leads to the start, a fit that is worse is of another place
        least = p.search_threshold if self.has_odometry else max(p.search_threshold, usual)
        if found.score < least or found.prior_weight < 0.5:
            searched = match(submap, points, prior, strength, p)
            found = searched if searched.score > found.score else found
        if self.has_odometry and found.score < usual:
            # beside its place, where a wrong stamp leads, a scan may fit, but not as usual
            searched = self._matched_freely(submap, points, prior, strength, p.wide_window)
            found = searched if searched.score >= usual else found
        misfit = self._misfits(submap, points, found)
        if misfit and not agrees and not self.lasts(observation.stamp):
            turn = TURN if self.has_odometry else math.pi
            found = (
                recover_locally(submap, points, prior, self.kidnapping.usual, self._p, turn)
                or found
            )
            misfit = self._misfits(submap, points, found)
        if found.score < p.min_score or (misfit and not agrees):
            return Evidence(scan=True, misfit=misfit, beams=len(points), score=found.score)
        self.kidnapping.learn(found.score)
        information = self._information(submap, points, found)
        self._fuse(self._state, found, information, sweep)
        heading = float(self._state.anchor(0)[2])
        return Evidence(
            scan=True,
            used=True,
            misfit=misfit,
            beams=len(points),
            score=found.score,
            weak=weak_direction(information, heading, self._p.health.degeneracy_sigma),
            prior_weight=found.prior_weight,
            iterations=found.iterations,
        )

    def insert(self, observation: Observation, evidence: Evidence, elsewhere: bool) -> None:
        """Insert the scan into the submaps; a submap that is begun clones the pose.

        A single scan that does not fit is more likely a bad scan (a wrong stamp) than a new
        place, and would mislead all that follow; only where none fits for a while, it is new.
        Where it was taken ``elsewhere``, it would hide that the robot is lost.
        """
        if observation.points is None or observation.origin is None or elsewhere:
            return
        if len(observation.points) < self._p.scan_match.min_points:
            return
        if evidence.used or self.submaps.target is None:
            self._last_fit = observation.stamp
        elif observation.stamp - self._last_fit < self._p.health.input_timeout * 1e9:
            return
        if evidence.used and not self.has_odometry and self._is_loose():
            self.submaps.forget()
        self.submaps.insert(self._state, observation.points, observation.origin)

    def _is_loose(self) -> bool:
        """Whether the robot hardly knows any more where in its submap it is.

        Then a post that comes in sight may be any of those in it: what fits there tells nothing,
        and a scan in the wrong place would spoil it. In a submap that begins here, the next scans
        tell how the robot moves, while the anchor keeps how unsure it is of where.
        """
        _, cov = relative(self._state.x, self._state.P)
        return ends_of(cov[:2, :2])[1] > LOOSE**2

    def lasts(self, stamp: int) -> bool:
        """Whether the contradiction lasts for so long that the robot is lost."""
        return self.kidnapping.lasts(stamp, self._p.health.lost_time)
