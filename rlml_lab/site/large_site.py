# SPDX-License-Identifier: Apache-2.0
"""A large simulated site: racks, reflectors, and drives of many sessions through its aisles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.params import SimulatorParameters, from_mapping
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world import (
    NO_REFLECTOR,
    Geometry,
    ReflectorSet,
    World,
    box_corners,
)

AISLE = 10.0  # [m] between crossings
RACK = 6.0  # [m] sides of what stands between four crossings
DOCKS = 3  # per side; crossings from which most sessions start
REFLECTOR = 0.06  # [m] diameter
NEAR = 1.0  # [m] farther from every true one is none of them
MIN_GAP = 1.5  # [m] between two reflectors
MATT = (0.6, 0.0, 0.0, float(NO_REFLECTOR))
# few rays and few scans: forty sessions in minutes
CHEAP = {
    'laser.beams': 240, 'laser.ray_times': False, 'speed': 1.5, 'markers.sigma_range': 0.02,
    'markers.false_detections': 0.01,
}  # fmt: skip
RATES = {'laser.rate': 1.0, 'wheels.rate': 5.0, 'gyro.rate': 10.0, 'truth_rate': 1.0}  # per scan


@dataclass(frozen=True)
class LargeSite:
    """A square of ``side`` [m] with ``reflectors`` (m, 2) and racks at every place but aisles."""

    side: float
    reflectors: Array
    static: Geometry

    def world(self, route: Array, heading: float) -> World:
        """The site with one drive along ``route`` (k, 2)."""
        m = len(self.reflectors)
        marks = ReflectorSet(
            self.reflectors, np.full(m, REFLECTOR), np.full(m, np.nan), np.arange(m)
        )
        start = np.array([*route[0], heading])
        return World('site', 'a large site', self.static, marks, (), start, route)


def make_site(side: float, num_reflectors: int, rng: np.random.Generator) -> LargeSite:
    """Racks of different lengths between aisles, and reflectors beside them at random."""
    middles = np.arange(0.5 * AISLE, side, AISLE)
    segments, marks = [], list[Array]()
    for x in middles:
        for y in middles:
            size = RACK * rng.uniform(0.4, 1.0, 2)
            corners = box_corners(np.array([x, y, 0.0]), (size[0], size[1]))
            segments += _sides(corners)
    wall = box_corners(np.array([0.5 * side, 0.5 * side, np.pi]), (side + 4.0, side + 4.0))
    segments += _sides(wall[::-1])
    while len(marks) < num_reflectors:  # beside the aisles, never within a rack
        p = rng.uniform(0.0, side, 2)
        from_aisle = 0.5 * AISLE - np.abs(p % AISLE - 0.5 * AISLE)
        free = (from_aisle > 1.0).all() and (from_aisle < 0.5 * (AISLE - RACK)).any()
        if free and all(np.hypot(*(p - q)) > MIN_GAP for q in marks):
            marks.append(p)
    static = Geometry(np.array(segments), np.zeros((0, 5)), np.tile(MATT, (len(segments), 1)))
    return LargeSite(side, np.array(marks), static)


def _sides(corners: Array) -> list[list[float]]:
    ends = np.roll(corners, -1, axis=0)
    return [[*a, *b, 0.0, 0.0] for a, b in zip(corners, ends, strict=True)]


def make_route(side: float, start: Array, length: float, rng: np.random.Generator) -> Array:
    """A walk (k, 2) from crossing to crossing, never straight back."""
    at, last, points = np.array(start), np.zeros(2), [np.array(start)]
    while AISLE * (len(points) - 1) < length:
        steps = [np.array(s) for s in ((AISLE, 0.0), (-AISLE, 0.0), (0.0, AISLE), (0.0, -AISLE))]
        steps = [
            s for s in steps
            if (at + s >= 0.0).all() and (at + s <= side).all() and (s + last).any()
        ]  # fmt: skip
        # rather ahead: a drive through a site is no stroll
        ahead = [s for s in steps if not (s - last).any()]
        step = ahead[0] if ahead and rng.random() < 0.6 else steps[rng.integers(len(steps))]
        at, last = at + step, step
        points.append(at)
    return np.array(points)


def simulation(site: LargeSite, route: Array, seed: int, scans: float) -> Simulation:
    """One drive."""
    first = route[1] - route[0]
    heading = float(np.arctan2(first[1], first[0]))
    return Simulation(site.world(route, heading), simulator_parameters(scans), seed)


def simulator_parameters(scans: float) -> SimulatorParameters:
    """Cheap sensors, with ``scans`` a second."""
    rates = {name: scans * each for name, each in RATES.items()}
    return from_mapping(CHEAP | rates, SimulatorParameters)


def docks(side: float) -> Array:
    """Crossings (DOCKS², 2) all over the site."""
    x = np.round(np.linspace(0.15, 0.85, DOCKS) * side / AISLE) * AISLE
    return np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)


def alignment_errors(found: Array, truth: Array) -> tuple[Array, Array]:
    """Distances (k,) [m] of reflectors to the true ones (m, 2) after the best rigid motion.

    ``found`` (k, 2) has to be near the truth already. Also which of the true ones were found.
    """
    nearest = np.linalg.norm(found[:, None] - truth, axis=-1)
    rows, gap = nearest.argmin(axis=1), nearest.min(axis=1)
    good = gap < NEAR
    T = se2.align(found[good], truth[rows[good]])
    error = np.linalg.norm(se2.transform(T, found) - truth[rows], axis=1)
    return error, np.unique(rows[good])
