# SPDX-License-Identifier: Apache-2.0
"""Absolute trajectory error: an estimate against ground truth, pose by pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import InputError
from rlml_slam.se2 import Array

MAX_GAP = 500_000_000  # [ns] truth is not interpolated over longer gaps


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors at the matched poses, in the axes of the truth's frame.

    ``stamps`` (n,), ``errors`` (n, 3) = estimate - truth with the heading wrapped (NaN where the
    truth has none), ``T_truth_map`` (3,) the alignment that was applied to the estimate, and
    ``unmatched`` poses without truth. ``indices`` (n,) are the matched poses of the estimate.
    """

    stamps: NDArray[np.int64]
    errors: Array
    T_truth_map: Array
    indices: NDArray[np.int64]
    unmatched: int

    @property
    def distances(self) -> Array:
        """Position errors (n,) [m]."""
        return np.asarray(np.hypot(self.errors[:, 0], self.errors[:, 1]))

    def summary(self) -> dict[str, float]:
        """The usual figures: of the position [m] and, where known, of the heading [deg]."""
        d, heading = self.distances, np.degrees(self.errors[:, 2])
        heading = heading[np.isfinite(heading)]
        out: dict[str, float] = {
            'matched': len(d),
            'unmatched': self.unmatched,
            'rmse_m': float(np.sqrt((d**2).mean())),
            'mean_m': float(d.mean()),
            'median_m': float(np.median(d)),
            'std_m': float(d.std()),
            'max_m': float(np.max(d)),
            'last_m': float(d[-1]),
        }
        if len(heading):
            out['heading_rmse_deg'] = float(np.sqrt((heading**2).mean()))
        return out


def interpolate(
    truth: Trajectory, stamps: NDArray[np.int64], max_gap: int = MAX_GAP
) -> tuple[Array, NDArray[np.bool_]]:
    """Truth (n, 3) at the stamps, and whether it is known there.

    It is known between two truth poses at most ``max_gap`` apart and at a truth pose itself.
    """
    t = truth.stamps
    after = np.clip(np.searchsorted(t, stamps), min(1, len(t) - 1), len(t) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(t[after] - t[before], 1)
    fraction = (stamps - t[before]) / span
    exact = (stamps == t[before]) | (stamps == t[after])
    inside = (fraction >= 0.0) & (fraction <= 1.0) & (span <= max_gap)
    fraction = np.clip(fraction, 0.0, 1.0)
    a, b = truth.poses[before], truth.poses[after]
    # component-wise: a truth without headings is interpolated as well
    step = b - a
    step[:, 2] = se2.wrap(step[:, 2])
    poses = a + fraction[:, None] * step
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses, inside | exact


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, aligned: bool = False, max_gap: int = MAX_GAP
) -> TrajectoryErrors:
    """Errors of an estimate against the truth interpolated to its stamps.

    ``aligned``: the estimate is first moved by the SE(2) transform that fits its positions best.
    Raises InputError if the two share no time, or too little to align.
    """
    at, known = interpolate(truth, estimate.stamps, max_gap)
    if not known.any():
        raise InputError('the trajectory and its truth have no time in common')
    poses, at = estimate.poses[known], at[known]
    if aligned and len(at) < 2:
        raise InputError('the trajectory and its truth have one pose in common: too few to align')
    T = se2.align(poses[:, :2], at[:, :2]) if aligned else np.zeros(3)
    errors = se2.compose(T, poses) - at
    errors[:, 2] = se2.wrap(errors[:, 2])
    return TrajectoryErrors(
        estimate.stamps[known], errors, T, np.flatnonzero(known), int(np.sum(~known))
    )
