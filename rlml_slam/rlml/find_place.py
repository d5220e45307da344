# SPDX-License-Identifier: Apache-2.0
"""Where in a whole map a frame was taken, by its reflectors and its scan together.

Reflectors alone tell it in most places, but where there is a scan, it must fit there. Of several
places that the reflectors allow, the scan may tell which; where the two contradict each other,
nothing is unique.
"""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.constellation import Candidate, Constellation, locate
from rlml_slam.params import Parameters
from rlml_slam.rlml.relocalize import (
    MAX_SECOND,
    SPREAD,
    Relocation,
    is_mapped,
    relocalize,
    scan_fits,
)
from rlml_slam.se2 import Array
from rlml_slam.types import Observation, Reflectors, Verdict


def find_place(
    grid: OccupancyGrid | None,
    reflectors: Reflectors,
    observation: Observation | None,
    p: Parameters,
) -> Relocation:
    """Search an observation in a map, both parts of which are in the map frame."""
    points = None if observation is None else observation.points
    seen = None if observation is None else observation.detections
    if seen is None or not p.node.use_reflectors:
        return relocalize(grid, points, p)
    stars = locate(seen.points, seen.cov, reflectors.points, reflectors.cov, p.relocalization)
    if stars.verdict is Verdict.UNIQUE:
        (best,) = stars.candidates
        scores = _scores(grid, points, stars, p)
        if scores is None:
            return Relocation(Verdict.UNIQUE, f'{stars.why}; no scan to confirm it', *_at(best))
        if scores[0] >= p.loop_closure.min_score:
            why = f'{stars.why}, and the scan fits with score {scores[0]:.2f}'
            return Relocation(Verdict.UNIQUE, why, *_at(best), scores[0])
        why = f'{stars.why}, but there the scan has a score of {scores[0]:.2f}'
        return Relocation(Verdict.AMBIGUOUS, why, *_at(best), scores[0])
    by_scan = relocalize(grid, points, p)
    if stars.verdict is Verdict.IMPOSSIBLE:
        return by_scan
    return _of_several(stars, by_scan, grid, points, p)


def _of_several(
    stars: Constellation,
    by_scan: Relocation,
    grid: OccupancyGrid | None,
    points: Array | None,
    p: Parameters,
) -> Relocation:
    """The verdict where the reflectors allow several places, or may fit by chance."""
    by_chance = stars.chance > p.relocalization.risk
    if by_scan.verdict is Verdict.UNIQUE and by_scan.pose is not None:
        if by_chance or any(_near(c.pose, by_scan.pose) for c in stars.candidates):
            return by_scan
        why = f'the scan fits where the reflectors do not ({by_scan.why}; {stars.why})'
        return Relocation(
            Verdict.AMBIGUOUS, why, by_scan.pose, by_scan.cov, by_scan.score, by_scan.second
        )
    best = stars.candidates[0]
    scores = None if by_chance else _scores(grid, points, stars, p)
    if scores is not None and len(scores) > 1:
        second, first = np.argsort(scores)[-2:]
        fits = scores[first] >= p.loop_closure.min_score
        if fits and scores[second] <= MAX_SECOND * scores[first]:
            why = (
                f'{stars.why}; of these, the scan fits one with score {scores[first]:.2f}, '
                f'the next with {scores[second]:.2f}'
            )
            at = _at(stars.candidates[int(first)])
            return Relocation(Verdict.UNIQUE, why, *at, scores[first], scores[second])
    why = f'{stars.why}; the scan does not tell either: {by_scan.why}'
    return Relocation(Verdict.AMBIGUOUS, why, *_at(best))


def _scores(
    grid: OccupancyGrid | None, points: Array | None, stars: Constellation, p: Parameters
) -> list[float] | None:
    """How well the scan fits at each candidate, None without a scan or a map of scans."""
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
