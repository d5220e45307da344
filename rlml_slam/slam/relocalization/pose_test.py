# SPDX-License-Identifier: Apache-2.0
"""Whether a pose given by a user, or remembered from the last run, is the robot's."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import Search
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.grid_submap import is_mapped
from rlml_slam.slam.relocalization.scan_relocalization import Relocation, scan_fits
from rlml_slam.types import Frame, Reflectors, Verdict

# [m, m, rad] of a robot that nobody moved: a pose that needs more to fit is of another place
SIGMA = np.array([0.1, 0.1, 0.05])
NEAR = 5.0 * SIGMA  # a pose that was found within this is the same
GATE = 0.5  # [m] from a reflector of the map to one seen from a pose given by hand


def locate(search: Search, p: Parameters) -> Relocation:
    """Execute a search: of an observation in the whole map, or of the pose given."""
    saved = search.map
    if search.given is not None:
        return evaluate_pose(saved, search.given, p)
    return localize_globally(
        saved.grid, saved.reflectors, search.observation, p, search.complete, search.area
    )


def evaluate_pose(saved: SavedMap, frame: Frame, p: Parameters) -> Relocation:
    """Whether the frame fits the map at its own pose: UNIQUE there, or IMPOSSIBLE.

    Where there is a scan and a grid, the scan must fit; without, most of the detections must.
    """
    grid, points = saved.grid, frame.observation.points
    pose, cov = frame.T_map_base, frame.cov_map
    if grid is None or points is None or not is_mapped(grid):
        return _by_reflectors(saved.reflectors, frame)
    if len(points) < p.scan_match.min_points:
        return Relocation(Verdict.IMPOSSIBLE, 'the newest frame has no usable scan')
    score, least = float(scan_fits(grid, points, pose[None], p)[0, 0]), p.loop_closure.min_score
    if score < least:
        why = f'at the pose given, the scan has a score of {score:.2f}; {least:.2f} is required'
        return Relocation(Verdict.IMPOSSIBLE, why, score=score)
    why = f'at the pose given, the scan fits with score {score:.2f}'
    return Relocation(Verdict.UNIQUE, why, pose, cov, score)


def _by_reflectors(reflectors: Reflectors, frame: Frame) -> Relocation:
    seen = frame.observation.detections
    if seen is None or len(seen) < 2 or not len(reflectors):
        return Relocation(Verdict.IMPOSSIBLE, 'nothing was seen that could confirm the pose given')
    at = se2.transform(frame.T_map_base, seen.points)
    gap = np.linalg.norm(at[:, None] - reflectors.points, axis=-1).min(axis=1)
    fitting = int((gap < GATE).sum())
    why = f'at the pose given, {fitting} of {len(seen)} reflectors are where the map has one'
    if fitting < 2 or 2 * fitting < len(seen):
        return Relocation(Verdict.IMPOSSIBLE, why)
    return Relocation(Verdict.UNIQUE, why, frame.T_map_base, frame.cov_map)


def verified(last: Array, found: Relocation) -> tuple[tuple[Array, Array] | None, str]:
    """Where to start, pose (3,) and covariance (3, 3), or None; and why, in words.

    ``last`` (3,) is the pose at the end of the last run, ``found`` where the first frame fits in
    the whole map. Where several places fit, a last pose that is one of them is for the front end
    to confirm or to reject.
    """
    x, y, theta = last
    name = f'the last pose, x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°'
    if found.verdict is Verdict.IMPOSSIBLE or found.pose is None or found.cov is None:
        return None, f'{name}, is not restored: {found.why}'
    if found.verdict is Verdict.AMBIGUOUS:
        return (last, np.diag(SIGMA**2)), f'{name}, is tried: {found.why}'
    if (np.abs(se2.between(last, found.pose)) < NEAR).all():
        return (found.pose, found.cov), f'{name}, is restored: {found.why}'
    x, y, theta = found.pose
    elsewhere = f'x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°'
    return None, f'{name}, is not restored: the robot is rather at {elsewhere}: {found.why}'
