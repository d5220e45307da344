# SPDX-License-Identifier: Apache-2.0
"""Visibility of mapped reflectors: which of them the detector should see from a pose.

A reflector is visible only where the scan itself shows a free line of sight: a beam in its
direction ended at it, or behind it. Without such a beam it is not expected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import kernel
from rlml_slam.errors import ParameterError
from rlml_slam.se2 import Array

BEAM = 0.02  # [rad] between a beam and a reflector that it may hit: half a coarse scanner's step
DEPTH = 0.3  # [m] a beam that ends this far before a reflector is blocked, with the pose's error
NONE = np.zeros((0, 2))
SHARE = 0.9  # of the largest range at which one was seen: beyond, it may be missed


def sectors(bearings: Sequence[float]) -> Array:
    """Pairs (k, 2) of begin and end of muted sectors [rad]. Raises ParameterError if odd."""
    if len(bearings) % 2:
        raise ParameterError(
            f'reflector.muted_sectors has {len(bearings)} bearings: pairs of begin and end are '
            'needed'
        )
    return np.array(bearings, dtype=np.float64).reshape(-1, 2)


def expected(
    pose: Array, reflectors: Array, points: Array, origin: Array, max_range: float,
    muted: Array = NONE,
) -> NDArray[np.bool_]:  # fmt: skip
    """Whether each of ``reflectors`` (m, 2) should be seen from ``pose`` (3,), as booleans (m,).

    ``points`` (n, 2) are the end points of a scan from ``origin`` (2,), both in the base frame;
    ``max_range`` [m] is the largest range at which a reflector was seen so far; ``muted`` (k, 2)
    are sectors of the detector that say nothing.
    """
    place = se2.transform(se2.inverse(pose), reflectors) - origin
    out: NDArray[np.bool_] = _is_visible(place, points, origin, SHARE * max_range)
    bearing = np.arctan2(place[:, 1], place[:, 0])
    for begin, end in muted:
        out &= np.mod(bearing - begin, 2.0 * math.pi) >= np.mod(end - begin, 2.0 * math.pi)
    return out


@kernel
def _is_visible(place: Array, points: Array, origin: Array, max_range: float) -> NDArray[np.bool_]:
    """Whether the beams towards each place (m, 2) in the laser frame end at it or behind."""
    out = np.zeros(len(place), dtype=np.bool_)
    x, y = points[:, 0] - origin[0], points[:, 1] - origin[1]
    ends = np.empty(len(points))  # along the line of sight; inf for other beams
    for k in range(len(place)):
        far = math.hypot(place[k, 0], place[k, 1])
        if not DEPTH < far < max_range:
            continue
        ux, uy = place[k, 0] / far, place[k, 1] / far
        for n in range(len(points)):
            along = ux * x[n] + uy * y[n]
            ends[n] = along if abs(ux * y[n] - uy * x[n]) < BEAM * along else math.inf
        shortest = math.inf
        for end in ends:
            shortest = min(shortest, end)
        out[k] = far - DEPTH < shortest < math.inf
    return out


def warm_up() -> None:
    """Compile the kernel."""
    expected(np.zeros(3), np.ones((1, 2)), np.ones((1, 2)), np.zeros(2), 1.0)
