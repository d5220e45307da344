# SPDX-License-Identifier: Apache-2.0
"""Whether a laser sits where the transforms say: scans of a robot that turns have to overlap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import project
from rlml_slam.sensing.mirror import mirrored_scan
from rlml_slam.types import Scan

Mounting = Callable[[Scan, Array], tuple[Scan, Array]]
Sighting = tuple[Scan, Array]  # a scan with the pose (3,) of base in odom
TURN, WAY = 0.15, 1.0  # [rad] at least and [m] at most between two scans that are compared
PAIRS = 12
RANGE = 15.0  # [m]
SHIFTED = 0.03  # [m] mean distance of two scans that do not overlap
BETTER = 0.6  # share of it that another mounting leaves
FLIP_X, FLIP_Y = np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])
BACK, OTHER_WAY = np.array([0.0, 0.0, np.pi]), np.array([1.0, 1.0, -1.0])
# what is wrong -> how the scan and the pose (3,) of the laser would be right
MOUNTINGS: dict[str, Mounting] = {
    'is as /tf_static says': lambda s, T: (s, T),
    'is mirrored, left is right: it hangs upside down, or its driver turns it round': (
        lambda s, T: (mirrored_scan(s), T)
    ),
    'looks backwards': lambda s, T: (s, T + BACK),
    'is mirrored and looks backwards': lambda s, T: (mirrored_scan(s), T + BACK),
    'sits on the other side (sign of y)': lambda s, T: (s, T * FLIP_Y),
    'sits at the other end (sign of x)': lambda s, T: (s, T * FLIP_X),
    'is turned the other way (sign of yaw)': lambda s, T: (s, T * OTHER_WAY),
}


def pairs_of(seen: Sequence[Sighting]) -> list[tuple[Sighting, Sighting]]:
    """At most PAIRS of scans between which the robot turned and did not go far."""
    out = []
    for i, first in enumerate(seen):
        for second in seen[i + 1 :]:
            step = se2.between(first[1], second[1])
            if abs(step[2]) > TURN and np.hypot(step[0], step[1]) < WAY:
                out.append((first, second))
                break
    return out[:: max(1, len(out) // PAIRS)][:PAIRS]


def distances(pairs: Sequence[tuple[Sighting, Sighting]], T_base_laser: Array) -> dict[str, float]:
    """Median distance [m] of the end points of two scans to each other, by mounting."""
    return {
        name: float(np.median([_distance(*pair, mounted, T_base_laser) for pair in pairs]))
        for name, mounted in MOUNTINGS.items()
    }


def _distance(first: Sighting, second: Sighting, mounted: Mounting, T_base_laser: Array) -> float:
    points = []
    for scan, T_odom_base in (first, second):
        s, T = mounted(scan, T_base_laser)
        points.append(se2.transform(T_odom_base, project(s, T, np.zeros((1, 3)), RANGE)))
    if min(map(len, points)) < 20:
        return np.inf
    d, _ = cKDTree(points[0]).query(points[1])
    return float(np.mean(np.sort(d)[: int(0.7 * len(d))]))  # what only one of them sees is left


def wrong_mounting(found: Mapping[str, float]) -> str:
    """What is wrong, in words; empty where the scans overlap or nothing explains them."""
    names = list(found)
    best = min(names, key=lambda name: found[name])
    if found[names[0]] < SHIFTED or found[best] > BETTER * found[names[0]]:
        return ''
    return best
