# SPDX-License-Identifier: Apache-2.0
"""How late the LEGO robot's streams are stamped, each without the error that is reported.

The scanner against the wheels by turns: those between two scans, from what both see of the same
cylinders alone, are those of the wheels that much earlier. The camera against the wheels by ways:
the chords of its track are those of the wheels, by a factor. Neither needs the map or the filter's
places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rlml_lab.datasets.lego import T_BASE_LASER, Lego
from rlml_lab.lego.lego_scale import Ranges
from rlml_slam import se2
from rlml_slam.se2 import Array

STARTS = np.arange(-1.0, 1.01, 0.1)  # [s] a lag beyond is not looked for
SPAN = 10  # pictures of a chord, some 2 s
ROBUST_TURN, ROBUST_WAY = 0.03, 0.01  # [rad], [m] scales of the losses


@dataclass(frozen=True)
class Lag:
    """What a stream is later than ``data`` has it, 1 sigma, and its ``factor`` over the wheels."""

    seconds: float
    sigma: float
    factor: float


def scan_lag(data: Lego, ranges: Ranges, offset: float) -> Lag:
    """By the turns from each scan to the next; ``offset`` [m] is between range and cylinder."""
    points = (ranges.measured + offset)[:, None] * np.stack(
        [np.cos(ranges.bearings), np.sin(ranges.bearings)], -1
    )
    rows = []
    for k in range(len(data.scans) - 1):
        a, b = np.flatnonzero(ranges.scans == k), np.flatnonzero(ranges.scans == k + 1)
        _, i, j = np.intersect1d(ranges.cylinders[a], ranges.cylinders[b], return_indices=True)
        if len(i) < 2:
            continue
        p, q = points[a[i]], points[b[j]]
        lever = float(np.sqrt(((p - p.mean(axis=0)) ** 2).sum()))
        rows.append((*ranges.times[[a[i[0]], b[j[0]]]], se2.align(q, p)[2], lever))
    before, after, turn, lever = np.array(rows).T
    at, heading = _wheels(data)

    def errors(lag: float, factor: float) -> Array:
        wheels = np.interp(after - lag, at, heading[:, 2]) - np.interp(
            before - lag, at, heading[:, 2]
        )
        out: Array = lever * (turn - factor * wheels) / ROBUST_TURN
        return out

    return _lag(errors)


def camera_lag(data: Lego) -> Lag:
    """By the chords of the track, over ``SPAN`` pictures each."""
    t, seen = data.track.stamps * 1e-9, data.track.poses[:, :2]
    chord = np.hypot(*(seen[SPAN:] - seen[:-SPAN]).T)
    at, base = _wheels(data)
    place = se2.transform(base, np.tile(T_BASE_LASER[:2], (len(base), 1))[:, None])[:, 0]

    def errors(lag: float, factor: float) -> Array:
        xy = np.stack([np.interp(t - lag, at, place[:, i]) for i in (0, 1)], -1)
        out: Array = (chord - factor * np.hypot(*(xy[SPAN:] - xy[:-SPAN]).T)) / ROBUST_WAY
        return out

    return _lag(errors)


def _wheels(data: Lego) -> tuple[Array, Array]:
    """Times (n,) [s] and poses (n, 3) of odometry, headings unwrapped."""
    poses = np.array([o.pose for o in data.odometry])
    poses[:, 2] = np.unwrap(poses[:, 2])
    return np.array([o.stamp for o in data.odometry]) * 1e-9, poses


def _lag(errors: Callable[[float, float], Array]) -> Lag:
    """The lag and factor of the least errors; overlapping chords are not independent."""
    fits = [
        least_squares(lambda q: errors(*q), [s, 1.0], loss='soft_l1', diff_step=1e-4)
        for s in STARTS
    ]
    best = min(fits, key=lambda f: f.cost)
    e = errors(*best.x)
    cov = np.linalg.inv(best.jac.T @ best.jac) * float(np.mean(e**2))
    return Lag(float(best.x[0]), float(np.sqrt(cov[0, 0])), float(best.x[1]))
