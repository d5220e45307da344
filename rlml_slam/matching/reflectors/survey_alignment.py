# SPDX-License-Identifier: Apache-2.0
"""Pose of a map of reflectors in the frame of a survey, or none where it is not unique.

It is computed from at least three reflectors that have an id in common with the survey, if they
stand as surveyed; else from the constellation of all reflectors, if it fits at one pose only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.constellation import locate
from rlml_slam.matching.reflectors.pair_votes import MIN_MATCHES
from rlml_slam.params import Relocalization
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Reflectors, Verdict

MATCH = 4.0  # sigmas within which a reflector of the map is one of the survey
ROUNDS = 5  # of pairing and fitting: the first pairs may lack some at the edge


@dataclass(frozen=True)
class Placement:
    """``T_survey_map`` (3,), None where it is not determined, and the reason ``why``.

    ``pairs`` (k, 2) are rows of the map and of the survey.
    """

    T_survey_map: Array | None
    pairs: NDArray[np.int64]
    why: str


def place(found: Reflectors, surveyed: Survey, sigma: float) -> Placement:
    """Find a map in a survey whose places are known to ``sigma`` [m] per axis."""
    rows, named = _common_ids(found, surveyed)
    if len(rows) >= MIN_MATCHES:
        T = se2.align(found.points[rows], surveyed.points[named])
        d = se2.transform(T, found.points[rows]) - surveyed.points[named]
        S = _turned(found.cov[rows], T[2]) + sigma**2 * np.eye(2)
        d2 = np.einsum('ni,ni->n', d, np.linalg.solve(S, d[..., None])[..., 0])
        if (d2 < gate(Relocalization().gate)).all():
            return _refined(found, surveyed, T, sigma, f'{len(rows)} ids stand as surveyed')
    for name, n in (('map', len(found)), ('survey', len(surveyed.points))):
        if n < MIN_MATCHES:
            why = f'the {name} has {n} reflectors, three are needed'
            return Placement(None, np.zeros((0, 2), dtype=np.int64), why)
    cov = np.tile(sigma**2 * np.eye(2), (len(surveyed.points), 1, 1))
    stars = locate(found.points, found.cov, surveyed.points, cov, Relocalization())
    if stars.verdict is not Verdict.UNIQUE:
        return Placement(None, np.zeros((0, 2), dtype=np.int64), stars.why)
    return _refined(found, surveyed, stars.candidates[0].pose, sigma, stars.why)


def _refined(
    found: Reflectors, surveyed: Survey, T: Array, sigma: float, why: str
) -> Placement:  # fmt: skip
    """The pose that makes the sum of the squared residuals of all pairs as small as it can be."""
    pairs = np.zeros((0, 2), dtype=np.int64)
    for _ in range(ROUNDS):
        pairs = pairs_at(found, surveyed, T, sigma)
        if len(pairs) < MIN_MATCHES:
            return Placement(None, pairs, f'{why}, but only {len(pairs)} stand where surveyed')
        T = se2.align(found.points[pairs[:, 0]], surveyed.points[pairs[:, 1]])
    return Placement(T, pairs, why)


def pairs_at(found: Reflectors, surveyed: Survey, T: Array, sigma: float) -> NDArray[np.int64]:
    """Rows (k, 2) of the map and of the survey that are one reflector, the map being at ``T``.

    Each is the nearest of the other, near enough, and no ids say otherwise.
    """
    there = se2.transform(T, found.points)
    gap = np.linalg.norm(there[:, None] - surveyed.points[None], axis=-1)
    a, b = found.ids[:, None], surveyed.ids[None]
    gap[(a != b) & (a != ANONYMOUS) & (b != ANONYMOUS)] = np.inf
    limit = MATCH * np.sqrt(np.linalg.eigvalsh(found.cov)[:, -1] + sigma**2)
    near = (gap < limit[:, None]) & (gap == gap.min(axis=0, initial=np.inf))
    near &= gap == gap.min(axis=1, initial=np.inf)[:, None]
    return np.argwhere(near)


def _common_ids(
    found: Reflectors, surveyed: Survey
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the map and of the survey with the same id, ids that the map has twice left out."""
    ids, counts = np.unique(found.ids[found.ids != ANONYMOUS], return_counts=True)
    once = np.intersect1d(ids[counts == 1], surveyed.ids)
    rows = [np.flatnonzero(np.isin(x, once)) for x in (found.ids, surveyed.ids)]
    a, b = (
        r[np.argsort(x[r], kind='stable')]
        for r, x in zip(rows, (found.ids, surveyed.ids), strict=True)
    )
    return a, b


def _turned(cov: Array, theta: float) -> Array:
    R = se2.rotation(theta)
    turned: Array = R @ cov @ R.T
    return turned
