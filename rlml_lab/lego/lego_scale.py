# SPDX-License-Identifier: Apache-2.0
"""Whether the camera's metre is the laser's: ranges, camera track and true map alone.

Neither wheels nor the filter's places take part. The track is shifted, turned and scaled until the
distances from it to the cylinders are those that the laser measured, up to one offset of all
ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rlml_lab.datasets.lego import BEAM_TIME, T_BASE_LASER, Lego
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.params import Spikes
from rlml_slam.se2 import Array
from rlml_slam.sensing.features import spikes

NEAR = 0.25  # [m] a spike farther from every cylinder is of something else
ROBUST = 0.03  # [m] scale of the loss


@dataclass(frozen=True)
class Ranges:
    """``measured`` (k,) [m] at ``bearings`` (k,) of the ``cylinders`` (k,) in the ``scans`` (k,).

    ``times`` (k,) [s] are those of the beams.
    """

    measured: Array
    bearings: Array
    cylinders: NDArray[np.int64]
    scans: NDArray[np.int64]
    times: Array


@dataclass(frozen=True)
class ScaleFit:
    """A track ``scale`` times its size, 1 sigma apart, fits the ranges best.

    That grows or shrinks it about the point ``centre`` (2,) of the arena. ``offset`` [m] lies
    between a range and a cylinder's centre. ``rms`` [m] is what remains of so many ``ranges``.
    """

    scale: float
    sigma: float
    centre: Array
    offset: float
    rms: float
    ranges: int


def ranges_of(data: Lego, scanner: Array, params: Spikes) -> Ranges:
    """Ranges to the cylinders; the estimated ``scanner`` poses (n, 3) associate them."""
    stamps = np.array([scan.stamp for scan in data.scans])
    T = se2.align(scanner[:, :2], at(data.track, stamps * 1e-9))
    T_arena_laser = se2.compose(se2.compose(T, scanner), np.array([0.0, 0.0, T_BASE_LASER[2]]))
    rows = []
    for k, scan in enumerate(data.scans):
        found = spikes.extract(scan, replace(params, range_offset=0.0, cylindrical=False))
        where = se2.transform(T_arena_laser[k], found.points)
        gap = np.linalg.norm(where[:, None] - data.landmarks[None], axis=-1)
        for i in np.flatnonzero(gap.min(axis=1) < NEAR):
            x, y = found.points[i]
            time = scan.stamp * 1e-9 + float(found.beams[i]) * BEAM_TIME
            rows.append((np.hypot(x, y), np.arctan2(y, x), int(gap[i].argmin()), k, time))
    measured, bearings, cylinders, scans, times = zip(*rows, strict=True)
    return Ranges(
        np.array(measured), np.array(bearings), np.array(cylinders), np.array(scans),
        np.array(times),
    )  # fmt: skip


def at(track: Trajectory, times: Array) -> Array:
    """Where the track is (n, 2) at times (n,) [s]."""
    t = track.stamps * 1e-9
    return np.stack([np.interp(times, t, track.poses[:, i]) for i in (0, 1)], -1)


def fit_scale(
    track: Trajectory, landmarks: Array, ranges: Ranges, rigid: bool = False
) -> ScaleFit:
    """Fit track and landmarks (m, 2) to ranges; ``rigid`` keeps the track's size."""
    seen, to = at(track, ranges.times), landmarks[ranges.cylinders]
    middle = seen.mean(axis=0)

    def errors(q: Array) -> Array:
        # shift, turn, offset of the ranges, growth
        growth = 0.0 if rigid else q[4]
        place = middle + q[:2] + (1.0 + growth) * (seen - middle) @ se2.rotation(q[2]).T
        return np.asarray(np.hypot(*(to - place).T) - q[3] - ranges.measured)

    found = least_squares(errors, np.zeros(4 if rigid else 5), loss='soft_l1', f_scale=ROBUST)
    e = errors(found.x)
    rms = float(np.sqrt(np.mean(e**2)))
    offset = float(found.x[3])
    if rigid:
        return ScaleFit(1.0, 0.0, np.full(2, np.nan), offset, rms, len(e))
    scale = 1.0 + float(found.x[4])
    sigma = rms * np.sqrt(np.linalg.inv(found.jac.T @ found.jac)[4, 4])
    stays = np.linalg.solve(np.eye(2) - scale * se2.rotation(found.x[2]), found.x[:2])
    return ScaleFit(scale, float(sigma), middle + stays, offset, rms, len(e))
