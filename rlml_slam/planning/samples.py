# SPDX-License-Identifier: Apache-2.0
"""What is too slow for every place: information of the scan, and whether the pose is unique."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.matching.reflectors.constellation import locate
from rlml_slam.matching.scans import voxel_filter
from rlml_slam.params import Laser, Parameters
from rlml_slam.planning.bound import detection_cov
from rlml_slam.planning.site import Site
from rlml_slam.se2 import Array
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.slam.front_end.grid_localization import map_information
from rlml_slam.slam.relocalization.grid_submap import submap_of
from rlml_slam.types import Verdict

UPPER = np.triu_indices(3)
FAR = 0.5  # [m] from where the robot is, a pose is another place
FREQUENT = 0.02  # share of the places from which a motion is a pattern
SAME_TURN = math.radians(5.0)


def sees_all(fov: float) -> bool:
    """Whether a field of view [rad] is the whole circle."""
    return fov > 2.0 * math.pi - 1e-6


def scan_information(site: Site, place: Array, heading: float, p: Parameters, n: Laser) -> Array:
    """Information (6,) of a match of a noiseless scan with the grid, as in localization."""
    step = n.field_of_view / (n.beams if sees_all(n.field_of_view) else n.beams - 1)
    angles = heading - 0.5 * n.field_of_view + np.arange(n.beams, dtype=np.float64) * step
    reach = min(n.range_max, p.submap.max_laser_range)
    origins = np.tile(place, (n.beams, 1))
    ranges, _, _ = cast(origins, angles, np.zeros(n.beams), site.walls, reach)
    hit = np.isfinite(ranges)
    ends = ranges[hit, None] * np.stack([np.cos(angles[hit]), np.sin(angles[hit])], -1)
    points = voxel_filter.thin(ends, p.scan_match.voxel_size, p.scan_match.max_points)
    if len(points) < p.scan_match.min_points:
        return np.zeros(6)
    saved = submap_of(site.grid, p.submap)
    pose = saved.from_map(np.array([*place, 0.0]))
    H = map_information(saved.submap, points, pose, p)
    turned = se2.rotate_cov(H, saved.yaw) if saved.yaw else H
    return np.asarray(turned[UPPER], dtype=np.float64)


def rival(
    site: Site, place: Array, seen: NDArray[np.bool_], p: Parameters
) -> tuple[Verdict, Array]:
    """The verdict of relocalization on all that is seen, and the place it may be mistaken for.

    The robot is at ``place`` with heading zero; the other place (3,) is NaN if there is none.
    """
    z, r = site.reflectors.points[seen] - place, site.reflectors
    found = locate(z, detection_cov(z, p.reflector), r.points, site.cov, p.relocalization)
    others = (c.pose for c in found.candidates if is_elsewhere(c.pose, place))
    return found.verdict, next(others, np.full(3, np.nan))


def is_elsewhere(pose: Array, place: Array) -> bool:
    """Whether a pose (3,) is not that of the robot at ``place`` (2,) with heading zero."""
    return bool(np.hypot(*(pose[:2] - place)) > FAR or abs(pose[2]) > SAME_TURN)


def patterns(places: Array, rivals: Array) -> list[str]:
    """The motions (most frequent first) that make places (n, 2) look like others (n, 3)."""
    known = np.isfinite(rivals[:, 0])
    if not known.any():
        return []
    here, there = places[known], rivals[known]
    turn = there[:, 2]
    moved = np.stack([there[:, 0] - np.cos(turn) * here[:, 0] + np.sin(turn) * here[:, 1],
                      there[:, 1] - np.sin(turn) * here[:, 0] - np.cos(turn) * here[:, 1],
                      turn % (2.0 * np.pi)], -1)  # fmt: skip
    key = np.rint(moved / (FAR, FAR, SAME_TURN)).astype(np.int64)
    _, first, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    least = FREQUENT * len(places)
    order = [k for k in np.argsort(-count, kind='stable')[:5] if count[k] >= least]
    return [f'{_named(moved[first[k]])}: {count[k]} of {len(places)} places' for k in order]


def _named(T: Array) -> str:
    x, y, turn = float(T[0]), float(T[1]), float(se2.wrap(T[2]))
    if abs(turn) < SAME_TURN:
        return f'repeats after ({x:.1f}, {y:.1f}) m'
    # the fixed point of the motion
    c, s = math.cos(turn), math.sin(turn)
    centre = np.linalg.solve(np.array([[1.0 - c, s], [-s, 1.0 - c]]), T[:2])
    about = f'({centre[0]:.1f}, {centre[1]:.1f}) m'
    return f'looks the same turned by {abs(math.degrees(turn)):.0f}° about {about}'
