# SPDX-License-Identifier: Apache-2.0
"""Global localization by reflectors and scan together.

Reflectors alone are mostly sufficient, but the scan, if there is one, must match at their pose. If
the reflectors allow several poses, the scan may decide. If the two contradict each other, no pose
is unique.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.reflectors.constellation import Candidate, Constellation, locate
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.grid_submap import is_mapped
from rlml_slam.slam.relocalization.scan_relocalization import (
    MAX_SECOND,
    SPREAD,
    Relocation,
    relocalize,
    scan_fits,
)
from rlml_slam.slam.search_area import SearchArea
from rlml_slam.types import Observation, Reflectors, Verdict


def localize_globally(
    grid: OccupancyGrid | None,
    reflectors: Reflectors,
    observation: Observation | None,
    p: Parameters,
    complete: bool = True,
    area: SearchArea | None = None,
) -> Relocation:
    """Search an observation in a map, both parts of which are in the map frame.

    Of a map in the making, which is not ``complete``, what is missing speaks against no place.
    Scans are searched in the ``area``, None for the whole map.
    """
    points = None if observation is None else observation.points
    seen = None if observation is None else observation.detections
    if seen is None or not p.node.use_reflectors:
        return relocalize(grid, points, p, complete, area)
    stars = locate(seen.points, seen.cov, reflectors.points, reflectors.cov, p.relocalization)
    places = [c.pose for c in (*stars.candidates, *stars.rivals)]
    found = _by_both(stars, grid, points, p, complete, area)
    return replace(found, rivals=np.array(places).reshape(-1, 3))


def _by_both(
    stars: Constellation,
    grid: OccupancyGrid | None,
    points: Array | None,
    p: Parameters,
    complete: bool,
    area: SearchArea | None,
) -> Relocation:
    """The verdict by what the reflectors say, and by the scan."""
    if stars.verdict is Verdict.UNIQUE:
        (best,) = stars.candidates
        scores = _scores(grid, points, stars, p)
        if scores is None:
            return Relocation(Verdict.UNIQUE, f'{stars.why}; no scan to confirm it', *_at(best))
        score = float(scores[0, 0])
        if score >= p.loop_closure.min_score:
            why = f'{stars.why}, and the scan fits with score {score:.2f}'
            return Relocation(Verdict.UNIQUE, why, *_at(best), score)
        why = f'{stars.why}, but there the scan has a score of {score:.2f}'
        return Relocation(Verdict.AMBIGUOUS, why, *_at(best), score)
    by_scan = relocalize(grid, points, p, complete, area)
    if stars.verdict is Verdict.IMPOSSIBLE:
        return by_scan
    if stars.verdict is Verdict.NOT_SEARCHED:
        nowhere = by_scan.verdict is Verdict.IMPOSSIBLE
        verdict = Verdict.NOT_SEARCHED if nowhere else by_scan.verdict
        return replace(by_scan, verdict=verdict, why=f'{by_scan.why}; {stars.why}')
    return _of_several(stars, by_scan, grid, points, p, complete)


def _of_several(
    stars: Constellation,
    by_scan: Relocation,
    grid: OccupancyGrid | None,
    points: Array | None,
    p: Parameters,
    complete: bool,
) -> Relocation:
    """The verdict where the reflectors allow several places, or may fit by chance."""
    by_chance = stars.chance > p.relocalization.false_positive_probability
    scores = None if by_chance else _scores(grid, points, stars, p)
    if not complete and scores is not None and _is_twin(scores):
        why = f'{stars.why}; the scan may fit at more than one of these, as far as they are mapped'
        return Relocation(Verdict.AMBIGUOUS, why, *_at(stars.candidates[0]))
    if by_scan.verdict is Verdict.UNIQUE and by_scan.pose is not None:
        if by_chance or any(_near(c.pose, by_scan.pose) for c in stars.candidates):
            return by_scan
        why = f'the scan fits where the reflectors do not ({by_scan.why}; {stars.why})'
        return Relocation(
            Verdict.AMBIGUOUS, why, by_scan.pose, by_scan.cov, by_scan.score, by_scan.second
        )
    best = stars.candidates[0]
    if scores is not None and len(scores) > 1:
        first = int(np.argmax(scores[:, 0]))
        score, second = float(scores[first, 0]), float(np.delete(scores[:, 0], first).max())
        if score >= p.loop_closure.min_score and second <= MAX_SECOND * score:
            why = (
                f'{stars.why}; of these, the scan fits one with score {score:.2f}, '
                f'the next with {second:.2f}'
            )
            return Relocation(Verdict.UNIQUE, why, *_at(stars.candidates[first]), score, second)
    why = f'{stars.why}; the scan does not decide: {by_scan.why}'
    return Relocation(Verdict.AMBIGUOUS, why, *_at(best))


def _is_twin(scores: Array) -> bool:
    """Whether the scan may fit anywhere nearly as well as at the best candidate."""
    first = int(np.argmax(scores[:, 0]))
    rivals = np.delete(scores[:, 1], first)
    return bool((rivals > MAX_SECOND * scores[first, 0]).any())


def _scores(
    grid: OccupancyGrid | None, points: Array | None, stars: Constellation, p: Parameters
) -> Array | None:
    """How well the scan fits and may fit (q, 2) at each candidate; None without scan or map."""
    if grid is None or not is_mapped(grid):
        return None
    if points is None or len(points) < p.scan_match.min_points:
        return None
    return scan_fits(grid, points, np.array([c.pose for c in stars.candidates]), p)


def _at(c: Candidate) -> tuple[Array, Array]:
    return c.pose, c.cov


def _near(a: Array, b: Array) -> bool:
    """Whether a place found by the scan may be the one found by reflectors."""
    return bool((np.abs(se2.between(a, b)) < SPREAD).all())
