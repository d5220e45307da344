# SPDX-License-Identifier: Apache-2.0
"""Which reflectors of the map should be in view: reflectors that are gone, or a detector that is.

A reflector is expected only where the scan itself says that nothing stands before it: a beam in
its direction came back from where it stands, or from behind. Without such a beam nothing is said.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import kernel
from rlml_slam.se2 import Array

BEAM = 0.02  # [rad] a beam this near passes a reflector or hits it: half a coarse scanner's step
DEPTH = 0.3  # [m] before its place, a beam that ends hits something else, with the pose's error
SHARE = 0.9  # of the farthest range at which one was seen: there, one may be seen or not


def expected(
    pose: Array, reflectors: Array, points: Array, origin: Array, reach: float
) -> NDArray[np.bool_]:
    """Whether each of ``reflectors`` (m, 2) should be seen from ``pose`` (3,), as booleans (m,).

    ``points`` (n, 2) are the end points of a scan from ``origin`` (2,), both in the base frame;
    ``reach`` [m] is the farthest range at which a reflector was seen so far.
    """
    place = se2.transform(se2.inverse(pose), reflectors) - origin
    out: NDArray[np.bool_] = _passed(place, points, origin, SHARE * reach)
    return out


@kernel
def _passed(place: Array, points: Array, origin: Array, reach: float) -> NDArray[np.bool_]:
    """Whether beams towards each place (m, 2), seen from the laser, end there or behind."""
    out = np.zeros(len(place), dtype=np.bool_)
    x, y = points[:, 0] - origin[0], points[:, 1] - origin[1]
    ends = np.empty(len(points))  # along the way to the place; Inf of beams that go elsewhere
    for k in range(len(place)):
        far = math.hypot(place[k, 0], place[k, 1])
        if not DEPTH < far < reach:
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
