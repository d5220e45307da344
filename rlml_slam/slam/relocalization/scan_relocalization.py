# SPDX-License-Identifier: Apache-2.0
"""Global localization by scan matching: branch and bound over the whole map, without a prior.

The best pose is unique only if its score is high, no other pose has nearly the same score, and
the scan observes every direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.branch_and_bound import Criteria, WideResult, Window, wide
from rlml_slam.matching.scans.scan_match import match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.grid_submap import GridSubmap, is_mapped, possible, submap_of
from rlml_slam.slam.search_area import SearchArea
from rlml_slam.types import Verdict

SEARCHED = 150  # end points of the search; all of them count when its places are compared
SPREAD = np.array([0.5, 0.5, 0.2])  # [m, m, rad] a refined place lies within this of the found one
# Share of the best score that the next place may reach. Stricter than a closure's, which other
# edges may contradict: in a truly symmetric hall, the scores of twins differ by up to 7 %.
MAX_SECOND = 0.85
OPEN_SIGMA = 0.5  # [m] a pose with a larger sigma in a direction is not unique


@dataclass(frozen=True)
class Relocation:
    """Verdict with its reason; ``pose`` (3,) and ``cov`` (3, 3) of the best match, map frame.

    ``score`` and ``second`` are the mean hit probabilities of the best and the next best pose, 0
    if there is none. ``pose`` is None if no pose fits. ``rivals`` (k, 3) are all poses where
    reflectors fit, the best first.
    """

    verdict: Verdict
    why: str
    pose: Array | None = None
    cov: Array | None = None
    score: float = 0.0
    second: float = 0.0
    rivals: Array = field(default_factory=lambda: np.zeros((0, 3)))


def relocalize(
    grid: OccupancyGrid | None, points: Array | None, p: Parameters, complete: bool = True,
    area: SearchArea | None = None,
) -> Relocation:  # fmt: skip
    """Search ``points`` (n, 2), end points in the base frame, in a grid of the map frame.

    Where the map is not ``complete``, what it lacks at the next best place may be there. With an
    ``area``, the square around it is searched.
    """
    if grid is None or not is_mapped(grid):
        return Relocation(Verdict.IMPOSSIBLE, 'there is no map of scans yet')
    if points is None or len(points) < p.scan_match.min_points:
        return Relocation(Verdict.IMPOSSIBLE, 'the newest frame has no usable scan')
    saved = submap_of(grid, p.submap)
    submap = saved.submap
    points = voxel_filter.thin(points, p.scan_match.voxel_size, p.scan_match.max_points)
    searched = voxel_filter.thin(points, p.scan_match.voxel_size, SEARCHED)
    found = _search(saved, searched, p, area)
    if not found.complete:
        why = f'the search was ended after {found.lookups / 1e6:.0f} million look-ups'
        return Relocation(Verdict.NOT_SEARCHED, why)
    places = [
        _refined(submap, points, c.pose, p) for c in (found.best, found.second) if c is not None
    ]
    places.sort(key=lambda place: -place[1])
    least = p.loop_closure.min_score
    if not places or places[0][1] < least:
        score = places[0][1] if places else 0.0
        why = f'no pose fits: the best score is {score:.2f}, at least {least:.2f} is needed'
        return Relocation(Verdict.IMPOSSIBLE, why, score=score)
    second = places[1][1] if len(places) > 1 else 0.0
    if not complete and second:
        second = possible(submap, points, places[1][0], second, places[0][1])
    return _compared(saved, points, places[0], second, p)


def _compared(
    saved: GridSubmap, points: Array, best: tuple[Array, float], second: float, p: Parameters
) -> Relocation:
    """The verdict on a pose that fits, by the score of the next best one and by its covariance."""
    pose, score = best
    cov = se2.rotate_cov(_covariance(saved.submap, points, pose, p), saved.yaw)
    sigma = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    verdict, why = Verdict.UNIQUE, f'score {score:.2f}, the next best pose {second:.2f}'
    if second > MAX_SECOND * score:
        verdict, why = (
            Verdict.AMBIGUOUS,
            f'two poses fit equally well: scores {score:.2f} and {second:.2f}',
        )
    elif sigma > OPEN_SIGMA:
        verdict, why = (
            Verdict.AMBIGUOUS,
            f'the scan does not observe one direction: sigma {sigma:.1f} m',
        )
    return Relocation(verdict, why, saved.to_map(pose), cov, score, second)


def _search(
    saved: GridSubmap, points: Array, p: Parameters, area: SearchArea | None
) -> WideResult:
    """The two best places in the area or the whole map, from wherever a base may stand.

    A pose that fits has a lower score when it is refined than in the search. So the next best one
    that could be a rival of the least score that fits has at least ``MAX_SECOND`` of that.
    """
    bounds = saved.submap.bounds
    middle, half = 0.5 * (bounds[:2] + bounds[2:]), 0.5 * (bounds[2:] - bounds[:2])
    window = Window(np.array([*middle, 0.0]), (half[0], half[1]), np.pi, mapped=True)
    if area is not None:
        reach = min(area.distance, 2.0 * float(half.max()))
        turn = min(area.turn, np.pi)
        window = Window(saved.from_map(area.pose), (reach, reach), turn, mapped=True)
    criteria = Criteria(
        MAX_SECOND * p.loop_closure.min_score, separation_angle=2.0 * SPREAD[2],
        budget=p.relocalization.max_lookups,
    )  # fmt: skip
    return wide(saved.pyramid, points, window, criteria)


def scan_fits(grid: OccupancyGrid, points: Array, poses: Array, p: Parameters) -> Array:
    """Scores (q, 2) of ``points`` (n, 2), end points in the base frame, at or near poses (q, 3).

    The second of each is what the score may be where parts of the place are not mapped.
    """
    saved = submap_of(grid, p.submap)
    submap = saved.submap
    points = voxel_filter.thin(points, p.scan_match.voxel_size, p.scan_match.max_points)
    places = [_refined(submap, points, pose, p) for pose in saved.from_map(poses)]
    best = max(score for _, score in places)
    return np.array([[s, possible(submap, points, pose, s, best)] for pose, s in places])


def _refined(submap: Submap, points: Array, near: Array, p: Parameters) -> tuple[Array, float]:
    """Pose and score of a place by scan matching, which the search's lattice only comes near."""
    weak = np.diag(1.0 / SPREAD**2)
    result = match(submap, points, near, weak, p.scan_match, searched=False)
    return result.pose, result.score


def _covariance(submap: Submap, points: Array, pose: Array, p: Parameters) -> Array:
    """Of the pose, with the error of the map that more beams do not lower."""
    information = scan_information.information(submap, points, pose, p.scan_match)
    # a direction that the scan leaves open still needs a regular covariance
    regular = information + np.diag([1e-2, 1e-2, 1e-2])
    return np.asarray(
        np.linalg.inv(regular) + np.diag(p.loop_closure.variance_floor), dtype=np.float64
    )
