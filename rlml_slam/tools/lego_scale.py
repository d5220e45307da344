# SPDX-License-Identifier: Apache-2.0
"""Whether the camera's metre is the laser's: ranges, camera track and true map alone.

Neither wheels nor the filter's places take part. The track is shifted, turned and scaled until the
distances from it to the cylinders are those that the laser measured, up to one offset of all
ranges; given headings, the point of the robot that the camera follows is found as well.
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
    """``places`` (n, 2) of the laser, from a track ``scale`` times its size, 1 sigma apart.

    ``offset`` [m] lies between a range and a cylinder's centre; the camera follows the ``point``
    (2,) [m] ahead of the laser and to its left. ``rms`` [m] is what remains of so many ``ranges``.
    """

    places: Array
    scale: float
    sigma: float
    offset: float
    point: Array
    point_sigma: Array
    rms: float
    ranges: int


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


def fit_scale(
    track: Array,
    landmarks: Array,
    ranges: Ranges,
    rigid: bool = False,
    headings: Array | None = None,
) -> ScaleFit:
    """Fit track (n, 2) and landmarks (m, 2) to ranges; ``rigid`` keeps the track's size.

    ``headings`` (n,) of the laser, in the track's frame; without them the camera is taken to
    follow the laser itself.
    """
    middle, to = track.mean(axis=0), landmarks[ranges.cylinders]
    # shift, turn, offset of the ranges, growth, point
    free = np.array([True] * 4 + [not rigid] + [headings is not None] * 2)
    ahead = np.zeros(len(track)) if headings is None else headings

    def whole(q: Array) -> Array:
        out = np.zeros(len(free))
        out[free] = q
        return out

    def places(q: Array) -> Array:
        grown = middle + q[:2] + (1.0 + q[4]) * (track - middle) @ se2.rotation(q[2]).T
        out: Array = grown - se2.rotation(ahead + q[2]) @ q[5:]
        return out

    def errors(q: Array) -> Array:
        at = places(whole(q))[ranges.scans]
        return np.asarray(np.hypot(*(to - at).T) - whole(q)[3] - ranges.measured)

    found = least_squares(errors, np.zeros(free.sum()), loss='soft_l1', f_scale=ROBUST)
    q, e = whole(found.x), errors(found.x)
    rms = float(np.sqrt(np.mean(e**2)))
    sigma = whole(rms * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))))
    return ScaleFit(
        places(q), 1.0 + float(q[4]), float(sigma[4]), float(q[3]), q[5:], sigma[5:], rms, len(e)
    )
