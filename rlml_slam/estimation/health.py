# SPDX-License-Identifier: Apache-2.0
"""OK, DEGRADED or LOST, with the reasons: what a vehicle controller has to know."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rlml_slam.params import HealthLimits
from rlml_slam.se2 import Array
from rlml_slam.types import Health, Level

FEW = 3  # expected reflectors below this may be missed by chance, or stand behind glass


@dataclass(frozen=True)
class Evidence:
    """What the scan said in one step.

    ``misfit``: it fits far worse than scans did lately. ``weak`` is the direction [deg, 0..180) of
    the map in which the scan leaves the position open, None where there is none.
    """

    scan: bool = False
    used: bool = False
    misfit: bool = False
    beams: int = 0
    score: float = float('nan')
    weak: float | None = None
    prior_weight: float = 1.0
    iterations: int = 0


class HealthMonitor:
    """Remembers since when each input has been failing."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._held_by_reflectors = -(2**62)
        self._held_by_scan = -(2**62)
        self._odometry_seen = -(2**62)
        self._reflectors_matched = -(2**62)
        self._scan_fits = -(2**62)
        self._reflectors_there = -(2**62)
        self._first: int | None = None

    def judge(
        self,
        stamp: int,
        evidence: Evidence,
        odometry: bool,
        detections: int | None,
        used: int,
        cov: Array,
        unconfirmed: str = '',
        lost: bool = False,
        contradicted: bool = False,
        expected: int = 0,
        seen: int = 0,
    ) -> Health:
        """Health at ``stamp`` [ns]; ``detections`` is None where none were looked for.

        ``unconfirmed``: why the map that it localizes in does not agree with the pose, empty where
        it does; ``lost``: for too long; ``contradicted``: all that was seen for a while
        contradicts the map; ``seen``: so many of the ``expected`` reflectors of the map were.
        """
        reasons = [unconfirmed] if unconfirmed else []
        if self._first is None:
            self._first = stamp
            return Health(Level.DEGRADED if reasons else Level.OK, tuple(reasons))
        if contradicted:
            lost = True
            reasons.append('what is seen contradicts the map: was the robot carried away?')
        patience = int(self._limits.input_timeout * 1e9)

        def failing(since: int) -> bool:
            return stamp - max(since, self._first or stamp) > patience

        if odometry:
            self._odometry_seen = stamp
        if failing(self._odometry_seen):
            reasons.append('no odometry')
        if used >= 2:
            self._held_by_reflectors = stamp
        if used > 0 or not detections:
            self._reflectors_matched = stamp
        unmatched = failing(self._reflectors_matched)
        if unmatched:
            reasons.append(f'none of {detections} detected reflectors matches the map')
        if expected < FEW or 2 * seen > expected:
            self._reflectors_there = stamp
        if failing(self._reflectors_there):
            reasons.append(f'saw {seen} of {expected} expected reflectors')
        if evidence.used or not evidence.scan:
            self._scan_fits = stamp
        misfit = failing(self._scan_fits)
        if misfit:
            reasons.append(f'scan fits the submap by {evidence.score:.2f} only')
        weak = evidence.weak
        if evidence.used and weak is None:
            self._held_by_scan = stamp
        held = max(self._held_by_scan, self._held_by_reflectors)
        if failing(held):
            if weak is not None:
                reasons.append(f'nothing holds the position along {weak:.0f} deg of the map')
            elif not misfit:
                reasons.append('position is held by odometry alone')
        sigma = math.sqrt(ends_of(cov[:2, :2])[1])
        if sigma > self._limits.sigma_degraded:
            reasons.append(f'position uncertain by {sigma:.2f} m (1 sigma)')
        if sigma > self._limits.sigma_lost or (misfit and (unmatched or not used)):
            lost = True
        if lost:
            return Health(Level.LOST, tuple(reasons))
        return Health(Level.DEGRADED if reasons else Level.OK, tuple(reasons))


def weak_direction(information: Array, heading: float, weak_sigma: float) -> float | None:
    """Direction [deg, 0..180) in which the position has a larger sigma, if there is one.

    ``information`` (3, 3) of a pose is in axes that are turned by ``heading`` [rad].
    """
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = information.tolist()
    # marginal of the position: the heading is estimated along with it
    tt = max(tt, 1e-12)
    a, b, d = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    if 0.5 * (a + d) - math.hypot(0.5 * (a - d), b) >= weak_sigma**-2:
        return None
    # the axis of the smaller eigenvalue, from the double angle of the larger one's
    weak = 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
    return math.degrees(weak + heading) % 180.0


def ends_of(A: Array) -> tuple[float, float]:
    """The smaller and the larger eigenvalue of a symmetric matrix (2, 2)."""
    (a, b), (_, d) = A.tolist()
    mean, half = 0.5 * (a + d), math.hypot(0.5 * (a - d), b)
    return mean - half, mean + half
