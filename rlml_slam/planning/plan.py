# SPDX-License-Identifier: Apache-2.0
"""The plan of a layout: at each place, what is seen, how accurate the pose is, if it is unique."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.bound import Bound, bound, position_sigma
from rlml_slam.planning.driving import motion_variance
from rlml_slam.planning.regular_patterns import rows_of
from rlml_slam.planning.samples import patterns, rival, scan_information, sees_all
from rlml_slam.planning.site import Site
from rlml_slam.planning.visibility import close_pairs, visible
from rlml_slam.se2 import Array
from rlml_slam.types import Verdict

MAX_SAMPLES = 600  # places at which the scan and the uniqueness are evaluated
HEADINGS = 12  # of a laser that does not see all around
SQUARES = 8  # areas along the longer side


@dataclass(frozen=True)
class Goal:
    """Position sigma [m] while driving at ``speed`` [m/s], with ``hidden`` reflectors hidden.

    Speed 0: by a single scan.
    """

    sigma: float
    speed: float = 1.0
    hidden: int = 0

    def variance(self, p: Parameters, sensor: SimulatorParameters) -> float:
        """Variance q [m^2] of odometry between two scans, infinite for a single scan."""
        if self.speed == 0.0:
            return math.inf
        return motion_variance(self.speed, 1.0 / sensor.laser.rate, p.motion)

    def of(self, found: Bound) -> Array:
        """The sigma (n,) that counts."""
        return found.hidden[:, self.hidden - 1] if self.hidden else found.position


@dataclass(frozen=True)
class Plan:
    """Values at places (n, 2), of the worst heading where the laser does not see all around.

    ``in_view`` (n,) reflectors; bounds by ``reflectors`` alone, by the ``scan`` and by ``both``
    in a single scan; by both while ``driving``, which the ``goal`` is for, and which alone has
    sigmas with reflectors hidden.
    At ``sampled`` (s,) places: ``verdicts`` and the ``rivals`` (s, 3) they may be mistaken for.
    """

    site: Site
    goal: Goal
    places: Array
    in_view: NDArray[np.int64]
    reflectors: Bound
    scan: Array
    both: Bound
    driving: Bound
    sampled: NDArray[np.int64]
    verdicts: tuple[Verdict, ...]
    rivals: Array
    notes: tuple[str, ...]

    @property
    def is_unique(self) -> NDArray[np.bool_]:
        """Whether the reflectors alone give one pose, at each sampled place."""
        return np.array([v is Verdict.UNIQUE for v in self.verdicts], dtype=np.bool_)

    @property
    def is_reached(self) -> NDArray[np.bool_]:
        """Whether each place (n,) reaches the goal."""
        reached: NDArray[np.bool_] = self.goal.of(self.driving) <= self.goal.sigma
        return reached


def make_plan(
    site: Site, places: Array, p: Parameters, sensor: SimulatorParameters, goal: Goal
) -> Plan:
    """Evaluate a layout at ``places`` (n, 2); MapError where there is none."""
    if not len(places):
        raise MapError('there is no free place in the area; see --clearance and --area')
    seen, points = visible(site, places, p, sensor), site.reflectors.points
    fov, q = sensor.laser.field_of_view, goal.variance(p, sensor)
    angles = headings(fov)
    alone: list[Bound] = []
    both: list[Bound] = []
    driving: list[Bound] = []
    scans, counts = [], []
    for heading in angles:
        in_view = seen & within(places, points, heading, fov)
        scan = scans_at(site, places, heading, p, sensor)
        alone.append(bound(places, in_view, points, site.cov, p.reflector, hide=False))
        both.append(bound(places, in_view, points, site.cov, p.reflector, scan, hide=False))
        driving.append(bound(places, in_view, points, site.cov, p.reflector, scan, q))
        scans.append(scan)
        counts.append(in_view.sum(axis=1))
    worst = np.argmax([b.position for b in both], axis=0)
    fewest = np.argmin(counts, axis=0)
    chosen, answers = spread(len(places), MAX_SAMPLES), []
    for k in chosen:
        row = seen[k] & within(places[[k]], points, angles[fewest[k]], fov)[0]
        answers.append(rival(site, places[k], row, p))
    rivals = np.array([other for _, other in answers])
    close = [
        f'reflectors {site.reflectors.ids[a]} and {site.reflectors.ids[b]} are closer than '
        f'{p.reflector.min_separation:g} m: the detector sees one'
        for a, b in close_pairs(points, p.reflector.min_separation)
    ]
    return Plan(
        site, goal, places, np.min(counts, axis=0), _worst(alone),
        np.take_along_axis(np.array(scans), worst[None, :, None], 0)[0], _worst(both),
        _worst(driving), chosen, tuple(v for v, _ in answers), rivals,
        tuple(close + rows_of(points) + patterns(places[chosen], rivals)),
    )  # fmt: skip


def headings(fov: float) -> Array:
    """Headings [rad] at which places are evaluated: one is enough where the laser sees all."""
    return np.arange(1 if sees_all(fov) else HEADINGS, dtype=np.float64) * (2.0 * np.pi / HEADINGS)


def spread(n: int, most: int) -> NDArray[np.int64]:
    """Indices of at most ``most`` of n things, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def scans_at(
    site: Site, places: Array, heading: float, p: Parameters, sensor: SimulatorParameters
) -> Array:
    """Information (n, 6) of the scan: at MAX_SAMPLES places, elsewhere of the nearest one."""
    chosen = spread(len(places), MAX_SAMPLES)
    found = [scan_information(site, places[k], heading, p, sensor.laser) for k in chosen]
    nearest: Array = np.array(found)[cKDTree(places[chosen]).query(places)[1]]
    return nearest


def within(places: Array, points: Array, heading: float, fov: float) -> NDArray[np.bool_]:
    """Whether a laser at places (n, 2) with one heading has points (m, 2) in its view."""
    if sees_all(fov):
        return np.ones((len(places), len(points)), dtype=np.bool_)
    d = points - places[:, None]
    bearing = se2.wrap(np.arctan2(d[..., 1], d[..., 0]) - heading)
    inside: NDArray[np.bool_] = np.abs(bearing) <= 0.5 * fov + 1e-9
    return inside


def _worst(bounds: list[Bound]) -> Bound:
    """The largest sigmas over headings; the information of the heading worst in position."""
    worst = np.argmax([b.position for b in bounds], axis=0)
    information = np.array([b.information for b in bounds])
    return Bound(
        np.max([b.position for b in bounds], axis=0), np.max([b.heading for b in bounds], axis=0),
        np.max([b.hidden for b in bounds], axis=0),
        np.take_along_axis(information, worst[None, :, None], 0)[0],
    )  # fmt: skip


def square_size(places: Array) -> float:
    """Side [m] of the areas of the table: 1, 2 or 5 times a power of ten."""
    longest = float(np.ptp(places, axis=0).max())
    least = max(longest / SQUARES, 1.0)
    return next(s for k in range(9) for s in (10.0**k, 2.0 * 10.0**k, 5.0 * 10.0**k) if s >= least)


def areas(plan: Plan) -> list[dict[str, Any]]:
    """Figures of each square, which has a letter along x and a number along y from the corner."""
    size = square_size(plan.places)
    low = np.floor(plan.places.min(axis=0) / size)
    cell = (np.floor(plan.places / size) - low).astype(np.int64)
    rows = []
    for j, i in np.unique(cell, axis=0):
        mine = (cell == (j, i)).all(axis=1)
        corner = (low + np.array([j, i])) * size
        rows.append({'area': f'{chr(65 + j)}{i + 1}', 'x_m': corner[0], 'y_m': corner[1],
                     **_figures(plan, mine)})  # fmt: skip
    return rows


def figures(plan: Plan) -> dict[str, Any]:
    """What plan.json has: the whole, each area, notes, ambiguous places with their rivals."""
    everywhere = np.ones(len(plan.places), dtype=np.bool_)
    lost = [
        {'x_m': x, 'y_m': y, 'like_x_m': other[0], 'like_y_m': other[1], 'like_turn_rad': other[2]}
        for (x, y), other in zip(plan.places[plan.sampled].tolist(), plan.rivals.tolist(),
                                 strict=True)
        if math.isfinite(other[0])
    ]  # fmt: skip
    return {
        'reflectors': len(plan.site.reflectors), 'places': len(plan.places),
        'goal_m': plan.goal.sigma, 'speed_m_s': plan.goal.speed, 'hidden': plan.goal.hidden,
        'area_size_m': square_size(plan.places), **_figures(plan, everywhere),
        'areas': areas(plan), 'notes': list(plan.notes), 'mistaken': lost,
    }  # fmt: skip


def _figures(plan: Plan, mine: NDArray[np.bool_]) -> dict[str, Any]:
    """Figures of some of the places; a sigma that is open is None."""
    sampled = mine[plan.sampled]
    return {
        'in_view_min': int(plan.in_view[mine].min()),
        'in_view_median': float(np.median(plan.in_view[mine])),
        'reflectors_sigma_m': _percentiles(plan.reflectors.position[mine]),
        'scan_sigma_m': _percentiles(scan_sigma(plan)[mine]),
        'both_sigma_m': _percentiles(plan.both.position[mine]),
        'driving_sigma_m': _percentiles(plan.driving.position[mine]),
        'heading_sigma_rad': _percentiles(plan.both.heading[mine]),
        'one_hidden_sigma_m': _percentiles(plan.driving.hidden[mine, 0]),
        'two_hidden_sigma_m': _percentiles(plan.driving.hidden[mine, 1]),
        'goal_share': float(np.mean(plan.is_reached[mine])),
        'unique_share': float(np.mean(plan.is_unique[sampled])) if sampled.any() else None,
    }


def scan_sigma(plan: Plan) -> Array:
    """Position sigma (n,) by the scan alone."""
    return position_sigma(plan.scan)


def _percentiles(values: Array) -> dict[str, float | None]:
    """Median and largest."""
    found = {'median': np.percentile(values, 50, method='lower'), 'max': values.max()}
    return {k: float(v) if math.isfinite(v) else None for k, v in found.items()}
