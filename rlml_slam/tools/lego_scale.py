# SPDX-License-Identifier: Apache-2.0
"""Whether the camera's metre is the laser's: ranges, camera track and true map alone.

No wheels and no filter take part. The track is shifted, turned and scaled until the distances
from it to the cylinders are those that the laser measured, up to one offset of all ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rlml_slam import se2
from rlml_slam.params import Spikes
from rlml_slam.se2 import Array
from rlml_slam.sensing import spikes
from rlml_slam.tools.convert_lego import T_BASE_LASER, Lego

NEAR = 0.25  # [m] a spike farther from every cylinder is of something else
ROBUST = 0.03  # [m] scale of the loss


@dataclass(frozen=True)
class Ranges:
    """``measured`` (k,) [m] of the ``cylinders`` (k,) in the ``scans`` (k,)."""

    measured: Array
    cylinders: NDArray[np.int64]
    scans: NDArray[np.int64]


@dataclass(frozen=True)
class ScaleFit:
    """``places`` (n, 2) of the laser, which have ``scale`` times the track's size, 1 sigma apart.

    ``offset`` [m] lies between a range and a cylinder's centre; ``rms`` [m] is what remains.
    """

    places: Array
    scale: float
    sigma: float
    offset: float
    rms: float


def ranges_of(data: Lego, scanner: Array, params: Spikes) -> Ranges:
    """Ranges to the cylinders; the estimated ``scanner`` poses (n, 3) tell which is which."""
    heading = -T_BASE_LASER[2]
    T = se2.align(scanner[:, :2], data.track.poses[:, :2])
    T_arena_laser = se2.compose(se2.compose(T, scanner), np.array([0.0, 0.0, -heading]))
    rows = []
    for k, scan in enumerate(data.scans):
        found = spikes.extract(scan, replace(params, offset=0.0, round=False)).points
        where = se2.transform(T_arena_laser[k], found)
        gap = np.linalg.norm(where[:, None] - data.landmarks[None], axis=-1)
        for i in np.flatnonzero(gap.min(axis=1) < NEAR):
            rows.append((float(np.hypot(*found[i])), int(gap[i].argmin()), k))
    measured, cylinders, scans = zip(*rows, strict=True)
    return Ranges(np.array(measured), np.array(cylinders), np.array(scans))


def fit_scale(track: Array, landmarks: Array, ranges: Ranges, rigid: bool = False) -> ScaleFit:
    """Fit track (n, 2) and landmarks (m, 2) to ranges; ``rigid`` keeps the track's size."""
    middle = track.mean(axis=0)
    to = landmarks[ranges.cylinders]

    def places(q: Array) -> Array:
        out: Array = middle + q[:2] + (1.0 + q[4]) * (track - middle) @ se2.rotation(q[2]).T
        return out

    def errors(q: Array) -> Array:
        at = places(np.append(q, 0.0) if rigid else q)[ranges.scans]
        return np.asarray(np.hypot(*(to - at).T) - q[3] - ranges.measured)

    found = least_squares(errors, np.zeros(4 if rigid else 5), loss='soft_l1', f_scale=ROBUST)
    q = np.append(found.x, 0.0) if rigid else found.x
    e = errors(found.x)
    rms = float(np.sqrt(np.mean(e**2)))
    cov = rms**2 * np.linalg.inv(found.jac.T @ found.jac)
    sigma = 0.0 if rigid else float(np.sqrt(cov[4, 4]))
    return ScaleFit(places(q), 1.0 + float(q[4]), sigma, float(q[3]), rms)
