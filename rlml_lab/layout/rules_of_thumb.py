# SPDX-License-Identifier: Apache-2.0
"""Rules of thumb of layouts, each with what the bound says of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.bound import bound
from rlml_slam.planning.plan import Goal
from rlml_slam.planning.samples import rival
from rlml_slam.planning.site import Site
from rlml_slam.se2 import Array
from rlml_slam.simulation.world import NOTHING, ReflectorSet
from rlml_slam.types import Verdict

P, SENSOR = Parameters(), SimulatorParameters()
Q = Goal(0.01).variance(P, SENSOR)


def rules() -> list[dict[str, Any]]:
    """Figures in cm or shares, by rule and case."""
    rows = []
    for n in (2, 3, 4, 6, 8):
        rows.append(_row('number: all around at 10 m', f'{n}', _ring(n, 10.0)))
    for r in (3.0, 5.0, 10.0, 15.0, 20.0, 25.0):
        rows.append(_row('range: four all around', f'{r:g} m', _ring(4, r)))
    for degrees in (10, 20, 45, 90, 120, 180, 270):
        rows.append(_row('angle: three at 10 m within', f'{degrees}°', _fan(3, 10.0, degrees)))
    for step in (5.0, 10.0, 15.0, 20.0):
        rows.append(_row('spacing along a corridor, alternating', f'{step:g} m', _aisle(step)))
    for jitter in (0.0, 0.1, 0.2, 0.3, 0.5, 1.0):
        rule = 'asymmetry: 5 m lattice moved by up to'
        rows.append({'rule': rule, 'case': f'{jitter:g} m', 'one_scan_cm': None,
                     'driving_cm': None, 'unique': _unique(jitter)})  # fmt: skip
    return rows


def _row(rule: str, case: str, points: Array) -> dict[str, Any]:
    place = np.zeros((1, 2))
    near = points[np.hypot(*points.T) <= P.reflector.max_range]
    seen, cov = np.ones((1, len(near)), dtype=np.bool_), np.zeros((len(near), 2, 2))
    sigma = [100.0 * float(bound(place, seen, near, cov, P.reflector, q=q).position[0])
             for q in (math.inf, Q)]  # fmt: skip
    return {'rule': rule, 'case': case, 'one_scan_cm': sigma[0], 'driving_cm': sigma[1],
            'unique': None}  # fmt: skip


def _ring(n: int, r: float) -> Array:
    """Evenly all around; two at a right angle."""
    return _fan(n, r, 360.0 * (n - 1) / n) if n > 2 else _fan(2, r, 90.0)


def _fan(n: int, r: float, degrees: float) -> Array:
    angle = np.radians(np.linspace(0.0, degrees, n))
    return r * np.stack([np.cos(angle), np.sin(angle)], -1)


def _aisle(step: float) -> Array:
    """Alternating on both sides of an aisle of 3 m; the place is midway between two."""
    k = np.arange(-20, 20)
    return np.stack([(k + 0.5) * step, 1.5 * (-1.0) ** k], -1)


def _unique(jitter: float) -> float:
    """Share of 200 places with a unique pose in 8 by 6 reflectors, seen up to 12 m."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(5.0 * np.arange(8), 5.0 * np.arange(6))
    points = np.stack([x.ravel(), y.ravel()], -1) + rng.uniform(-jitter, jitter, (48, 2))
    none, m = np.full(48, np.nan), np.arange(48)
    grid = OccupancyGrid(1.0, (0.0, 0.0), np.zeros((1, 1), dtype=np.int8))
    site = Site(
        NOTHING, ReflectorSet(points, np.full(48, 0.08), none, m), np.zeros((48, 2, 2)), grid
    )
    places = rng.uniform((2.0, 2.0), (33.0, 23.0), (200, 2))
    found = [rival(site, p, np.hypot(*(points - p).T) < 12.0, P)[0] for p in places]
    return float(np.mean([v is Verdict.UNIQUE for v in found]))
