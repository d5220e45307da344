# SPDX-License-Identifier: Apache-2.0
"""What a run saw of a layout, and what it should have seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.audit.sightings import Sightings
from rlml_slam.planning.site import Site
from rlml_slam.planning.visibility import visible
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.visibility import SHARE, sectors
from rlml_slam.types import Level

GATE, GATE_SIGMAS = 0.2, 3.0  # [m] of the pose, and sigmas of a detection: it is a reflector's
MARGIN, TURN = 0.1, 0.1  # [m], [rad] by which map and pose may err at the edge of a view
FACES = 36  # bearings about a reflector that may be flat, from each of which it is seen or not
BLOCK = 1.0  # [m] of travel within which misses have a common cause


@dataclass(frozen=True)
class Evidence:
    """Scans (n,) of a run against the reflectors (m,) of a site.

    ``planned`` (n, m): in view by the plan; ``expected``: so for certain. ``seen`` (n, m): the
    detection of it, -1 without one. ``points`` (k, 2) of the detections in the map frame,
    ``match`` (k,) their reflectors, -1 for none. ``block`` (n,): of travel.
    """

    site: Site
    sightings: Sightings
    planned: NDArray[np.bool_]
    expected: NDArray[np.bool_]
    seen: NDArray[np.int64]
    points: Array
    match: NDArray[np.int64]
    block: NDArray[np.int64]


def gather(site: Site, s: Sightings, p: Parameters, sensor: SimulatorParameters) -> Evidence:
    """Match detections to the nearest reflectors, and see which were in view.

    Scans in which the robot was lost are left out. Raises MapError if no scan is left.
    """
    s = _where_localized(s)
    points = se2.transform(s.poses[s.scan], s.points[:, None])[:, 0]
    match = _nearest(site, s, points)
    known = np.flatnonzero(match >= 0)
    if not len(known):
        raise MapError('no detection of the run is where the layout has a reflector')
    seen = np.full((len(s.stamps), len(site.reflectors)), -1, dtype=np.int64)
    seen[s.scan[known], match[known]] = known
    reach = float(np.hypot(*(s.points[known] - s.origin).T).max())
    planned, expected = _in_view(site, s, p, sensor, SHARE * reach)
    if not site.oriented:
        expected &= _faced(site, s.lasers, seen >= 0)
    travel = np.hypot(*np.diff(s.poses[:, :2], axis=0).T)
    block = np.floor(np.concatenate([[0.0], np.cumsum(travel)]) / BLOCK).astype(np.int64)
    return Evidence(site, s, planned, expected, seen, points, match, block)


def _where_localized(s: Sightings) -> Sightings:
    kept = s.levels < Level.LOST
    if not kept.any():
        raise MapError('the run has no scan in which the robot was localized')
    mine = kept[s.scan]
    row = np.cumsum(kept) - 1
    return replace(
        s, stamps=s.stamps[kept], poses=s.poses[kept], covs=s.covs[kept], levels=s.levels[kept],
        reasons=s.reasons[kept], scan=row[s.scan[mine]], points=s.points[mine], cov=s.cov[mine],
    )  # fmt: skip


def _nearest(site: Site, s: Sightings, points: Array) -> NDArray[np.int64]:
    """(k,): the nearest reflector inside the gate, one detection of a scan for each, or -1."""
    gap = np.hypot(*(points[:, None] - site.reflectors.points).transpose(2, 0, 1))
    sigma = np.sqrt(np.linalg.eigvalsh(s.cov)[:, -1])
    match = np.full(len(points), -1, dtype=np.int64)
    if not gap.size:
        return match
    near, distance = gap.argmin(axis=1), gap.min(axis=1)
    inside = np.flatnonzero(distance < GATE + GATE_SIGMAS * sigma)
    order = inside[np.argsort(distance[inside], kind='stable')]
    pairs = s.scan[order] * gap.shape[1] + near[order]
    first = order[np.unique(pairs, return_index=True)[1]]
    match[first] = near[first]
    return match


def _in_view(
    site: Site, s: Sightings, p: Parameters, sensor: SimulatorParameters, reach: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Planned and expected (n, m): by the plan, and with a margin for errors of map and pose."""
    n, m = len(s.stamps), len(site.reflectors)
    lasers, limit = s.lasers, sensor.markers.max_incidence - TURN
    planned = visible(site, lasers, p, sensor)
    strict = replace(sensor, markers=replace(sensor.markers, max_incidence=limit))
    around = np.concatenate([lasers + MARGIN * np.array(d)
                             for d in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))])  # fmt: skip
    expected = visible(site, around, p, strict).reshape(5, n, m).all(axis=0)
    d = site.reflectors.points - lasers[:, None]
    bearing = se2.wrap(np.arctan2(d[..., 1], d[..., 0]) - s.poses[:, 2:])
    half = 0.5 * sensor.laser.field_of_view
    planned &= np.abs(bearing) <= half
    if half < math.pi - 1e-6:
        expected &= np.abs(bearing) <= half - TURN
    expected &= np.hypot(d[..., 0], d[..., 1]) <= reach
    for begin, end in sectors(p.reflector.muted_sectors):
        muted = (bearing - begin) % (2.0 * np.pi) < (end - begin) % (2.0 * np.pi)
        planned &= ~muted
        expected &= ~muted
    return planned, expected


def _faced(site: Site, lasers: Array, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n, m): from bearings at which it was seen at all; a flat reflector has a back.

    One that was never seen faces everywhere.
    """
    d = lasers[:, None] - site.reflectors.points
    face = np.floor(np.arctan2(d[..., 1], d[..., 0]) * (FACES / (2.0 * np.pi))).astype(int) % FACES
    known = np.zeros((FACES, seen.shape[1]), dtype=np.bool_)
    scan, k = np.nonzero(seen)
    known[face[scan, k], k] = True
    known[:, ~seen.any(axis=0)] = True
    out: NDArray[np.bool_] = known[face, np.arange(seen.shape[1])]
    return out
