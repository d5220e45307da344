# SPDX-License-Identifier: Apache-2.0
"""Where in the map a lost robot may be."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rlml_slam import se2
from rlml_slam.estimation.health import eigenvalues_2x2
from rlml_slam.se2 import Array
from rlml_slam.types import Frame, Status

FARTHEST = 4.0  # [sigma] of where odometry led, along any axis: with the heading goes the rest
LEAST = (0.5, 0.2)  # [m], [rad] by which a place that was found may be moved to fit


@dataclass(frozen=True)
class SearchArea:
    """Poses within ``distance`` [m] and ``turn`` [rad] of ``pose`` (3,), map frame."""

    pose: Array
    distance: float
    turn: float

    @property
    def size(self) -> float:
        """Area [m²] at all headings that has the volume of the poses."""
        return (2.0 * self.distance) ** 2 * min(self.turn / math.pi, 1.0)

    def contains(self, pose: Array) -> bool:
        """Whether a pose (3,) is in it."""
        x, y, turn = se2.between(self.pose, pose).tolist()
        return math.hypot(x, y) <= self.distance and abs(turn) <= self.turn


def search_area(frame: Frame) -> SearchArea | None:
    """Where a lost robot may be, None for anywhere.

    A robot whose scan or reflectors do not match the map may have been moved anywhere. One that
    only drove where nothing was seen is where its odometry led, by the covariance of that.
    """
    misfit = not (frame.scan_used or math.isnan(frame.scan_score))
    unmatched = len(frame.statuses) > 0 and not (frame.statuses == Status.USED).any()
    if frame.unconfirmed or misfit or unmatched:
        return None
    sigma = math.sqrt(eigenvalues_2x2(frame.cov_map[:2, :2])[1])
    turn = FARTHEST * math.sqrt(float(frame.cov_map[2, 2]))
    return SearchArea(frame.T_map_base, max(FARTHEST * sigma, LEAST[0]), max(turn, LEAST[1]))
