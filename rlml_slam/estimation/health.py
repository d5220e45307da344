# SPDX-License-Identifier: Apache-2.0
"""Health of the estimate: OK, DEGRADED or LOST with the reasons, for the vehicle controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rlml_slam.params import HealthLimits
from rlml_slam.se2 import Array
from rlml_slam.types import Health, Level

FEW = 3  # fewer expected reflectors may all be missed by chance, or stand behind glass
NEVER = -(2**62)  # [ns]


@dataclass(frozen=True)
class ScanEvidence:
    """Result of the scan update of one step.

    ``misfit``: the score is far below the usual one. ``open_direction`` [deg, 0..180) of the map
    is the one in which the scan does not observe the position, None if it observes all.
    ``cov_submap`` (3, 3) is that of the pose relative to the ``submap`` that the scan matched,
    which is None for a robot without odometry.
    """

    has_scan: bool = False
    used: bool = False
    misfit: bool = False
    score: float = float('nan')
    open_direction: float | None = None
    iterations: int = 0
    submap: object = None
    cov_submap: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True)
class HealthInputs:
    """What one step says about the health of the estimate.

    ``detections``: their number, None if no detector has run; ``matched`` of them updated the
    estimate. ``cov_map`` (3, 3) is that of the pose, ``position`` (2,) its place. ``unconfirmed``:
    why the saved map does not confirm the pose, empty if it does; ``is_lost``: for too long.
    ``contradicted``: scan or reflectors have contradicted the map for too long. ``seen`` of the
    ``expected`` reflectors in view were detected. ``maps``: the map is in the making.
    ``mounting``: what is wrong with the laser's place on the robot, empty if nothing is.
    """

    scan: ScanEvidence
    has_odometry: bool
    detections: int | None
    matched: int
    cov_map: Array
    unconfirmed: str = ''
    is_lost: bool = False
    contradicted: bool = False
    expected: int = 0
    seen: int = 0
    maps: bool = False
    position: Array = field(default_factory=lambda: np.zeros(2))
    mounting: str = ''


class HealthMonitor:
    """Evaluates the health; stores the stamp [ns] at which each input was good last."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._odometry = NEVER
        self._detected = self._reflectors_matched = self._updated = NEVER
        self._num_detections, self._score = 0, 0.0  # the newest
        self._reflectors_seen = NEVER
        self._scanned = self._scan_matched = NEVER
        self._held_by_reflectors = NEVER
        self._held_by_scan = NEVER
        self._first: int | None = None
        # position and covariance when the map held the pose last, and the variance [m^2] of the
        # position that it had grown by while the map did not; and since then
        self._held = np.zeros(2), np.zeros((3, 3)), 0.0
        self._since = 0.0
        self._submap: object = None  # of the last match, and the variance [m^2] relative to it
        self._drifted = 0.0

    def evaluate(self, stamp: int, step: HealthInputs) -> Health:
        """Health at ``stamp`` [ns], after the first step."""
        reasons = [reason for reason in (step.unconfirmed, step.mounting) if reason]
        if self._first is None:
            self._first = stamp
            return Health(Level.DEGRADED if reasons else Level.OK, tuple(reasons))
        if step.contradicted:
            reasons.append(
                'scan and reflectors contradict the map: the robot may have been moved; '
                'waiting for relocalization'
            )
        self._note(stamp, step)
        unmatched = self._fails(self._reflectors_matched, stamp)
        misfit = self._fails(self._scan_matched, stamp)
        reasons += self._input_reasons(stamp, step, unmatched, misfit)
        sigma = math.sqrt(eigenvalues_2x2(step.cov_map[:2, :2])[1])
        if sigma > self._limits.sigma_degraded:
            reasons.append(f'position sigma is {sigma:.2f} m')
        heading_sigma = math.sqrt(float(step.cov_map[2, 2]))
        if heading_sigma > self._limits.heading_sigma_degraded:
            reasons.append(f'heading sigma is {math.degrees(heading_sigma):.1f} deg')
        is_lost = step.is_lost or step.contradicted or self._is_adrift(stamp, step, sigma)
        alone = self._fails(self._updated, stamp)  # no reflector has matched for as long
        if is_lost or (misfit and (unmatched or alone)):
            return Health(Level.LOST, tuple(reasons))
        return Health(Level.DEGRADED if reasons else Level.OK, tuple(reasons))

    def _is_adrift(self, stamp: int, step: HealthInputs, sigma: float) -> bool:
        """Whether the position is too uncertain to be known in the map.

        A map in the making grows away from its start, and the robot's place in it stays known
        while scan or reflectors hold the pose. What counts is what the variance grows by while
        they do not, beyond what the way since then turns by the heading that was uncertain before.
        A scan that leaves a direction open to odometry still holds the pose in its submap, but for
        what the variance grows by relative to that.
        """
        limit, scan = self._limits.sigma_lost**2, step.scan
        if not step.maps:
            return sigma**2 > limit
        (at, P, adrift), since = self._held, self._since
        x, y = (step.position - at).tolist()
        J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        self._since = sigma**2 - eigenvalues_2x2(J @ P @ J.T)[1]
        drifted, submap = self._drifted, self._submap
        if scan.used:
            self._drifted = eigenvalues_2x2(scan.cov_submap[:2, :2])[1]
            self._submap = scan.submap
        if stamp in (self._held_by_scan, self._held_by_reflectors):
            adrift += min(since, self._since)
        elif scan.submap is not None and scan.submap is submap:
            adrift += since + self._drifted - drifted
        elif adrift + self._since > 0.0:
            return adrift + self._since > limit
        adrift = min(max(adrift, 0.0), sigma**2)
        self._held, self._since = (step.position, step.cov_map, adrift), 0.0
        return adrift > limit

    def _note(self, stamp: int, step: HealthInputs) -> None:
        """Store the stamp of each input that is good in this step."""
        if step.has_odometry:
            self._odometry = stamp
        if step.matched >= 2:
            self._held_by_reflectors = stamp
        # frames may be of the scan or of the reflectors alone: one without says nothing of them,
        # unless there are none any more
        if step.detections is not None:
            self._detected, self._num_detections = stamp, step.detections
        if step.matched > 0:
            self._updated = stamp
        if step.matched > 0 or step.detections == 0 or self._fails(self._detected, stamp):
            self._reflectors_matched = stamp
        if step.expected < FEW or 2 * step.seen > step.expected:
            self._reflectors_seen = stamp
        if step.scan.has_scan:
            self._scanned, self._score = stamp, step.scan.score
        if step.scan.used or self._fails(self._scanned, stamp):
            self._scan_matched = stamp
        if step.scan.used and step.scan.open_direction is None:
            self._held_by_scan = stamp

    def _fails(self, last_good: int, stamp: int) -> bool:
        """Whether an input has not been good for longer than ``input_timeout``."""
        since = max(last_good, self._first or stamp)
        return stamp - since > int(self._limits.input_timeout * 1e9)

    def _input_reasons(
        self, stamp: int, step: HealthInputs, unmatched: bool, misfit: bool
    ) -> list[str]:
        reasons = []
        if self._fails(self._odometry, stamp):
            reasons.append('no odometry')
        if unmatched:
            reasons.append(f'none of {self._num_detections} detected reflectors matches the map')
        if self._fails(self._reflectors_seen, stamp):
            reasons.append(f'only {step.seen} of {step.expected} expected reflectors detected')
        if misfit and math.isnan(self._score):
            reasons.append('too few beams of the scan are in range')
        elif misfit:
            reasons.append(f'scan does not match the submap: score {self._score:.2f}')
        open_direction = step.scan.open_direction
        if self._fails(max(self._held_by_scan, self._held_by_reflectors), stamp):
            if open_direction is not None:
                reasons.append(
                    f'position along {open_direction:.0f} deg of the map is from odometry alone: '
                    'the scan does not observe it'
                )
            elif not misfit:
                reasons.append('position is from odometry alone')
        return reasons


def with_problems(health: Health, problems: tuple[str, ...]) -> Health:
    """The health, DEGRADED at least where there are problems."""
    if not problems:
        return health
    return Health(max(health.level, Level.DEGRADED), (*health.reasons, *problems))


def open_direction(information: Array, heading: float, max_sigma: float) -> float | None:
    """Direction [deg, 0..180) in which the position sigma exceeds ``max_sigma``, None if none.

    ``information`` (3, 3) of a pose is in axes that are rotated by ``heading`` [rad].
    """
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = information.tolist()
    # Schur complement: marginal information of the position, the heading being estimated too
    tt = max(tt, 1e-12)
    a, b, d = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    if 0.5 * (a + d) - math.hypot(0.5 * (a - d), b) >= max_sigma**-2:
        return None
    # axis of the smaller eigenvalue: normal to that of the larger, which is at half of this angle
    axis = 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
    return math.degrees(axis + heading) % 180.0


def eigenvalues_2x2(A: Array) -> tuple[float, float]:
    """The smaller and the larger eigenvalue of a symmetric matrix (2, 2)."""
    (a, b), (_, d) = A.tolist()
    mean, half = 0.5 * (a + d), math.hypot(0.5 * (a - d), b)
    return mean - half, mean + half
