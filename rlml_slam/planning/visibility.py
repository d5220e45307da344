# SPDX-License-Identifier: Apache-2.0
"""Which reflectors a place sees: light goes both ways, so each reflector casts one fan of rays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.site import Site
from rlml_slam.se2 import Array
from rlml_slam.simulation.ray_cast import cast

RAYS = 7200  # of one fan: 22 mm apart at 25 m
SLACK = 0.02  # [m] by which a place may be beyond the end of its ray
FRONT = 1e-3  # [m] before its face, the fan of a flat reflector starts


def max_range(p: Parameters, sensor: SimulatorParameters) -> float:
    """Range [m] up to which reflectors are detected and used."""
    return min(p.reflector.max_range, sensor.markers.max_range)


def visible(
    site: Site, places: Array, p: Parameters, sensor: SimulatorParameters
) -> NDArray[np.bool_]:
    """Whether each place (n, 2) sees each reflector (n, m), whatever the heading.

    By range, walls, other reflectors and the incidence on flat ones. Of two that are closer than
    ``min_separation``, the detector sees one.
    """
    r, reach = site.reflectors, max_range(p, sensor)
    seen = np.zeros((len(places), len(r)), dtype=np.bool_)
    geometry = site.walls.joined(r.geometry())
    angles = np.linspace(0.0, 2.0 * np.pi, RAYS, endpoint=False)
    for k, point in enumerate(r.points):
        normal = r.normals[k]
        is_flat = not math.isnan(normal)
        front = FRONT * np.array([math.cos(normal), math.sin(normal)]) if is_flat else 0.0
        d = places - point
        distance, bearing = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
        near = np.flatnonzero(distance <= reach)
        origins = np.broadcast_to(point + front, (RAYS, 2))
        ranges, _, _ = cast(origins, angles, np.zeros(RAYS), geometry, reach + 1.0)
        ray = np.rint(bearing[near] * (RAYS / (2.0 * np.pi))).astype(np.int64) % RAYS
        seen[near, k] = distance[near] <= ranges[ray] + SLACK
        if is_flat:
            cosine = np.cos(bearing[near] - normal)
            seen[near, k] &= cosine >= math.cos(sensor.markers.max_incidence)
    for a, b in close_pairs(r.points, p.reflector.min_separation):
        seen[:, b] &= ~seen[:, a]
    return seen


def close_pairs(points: Array, separation: float) -> list[tuple[int, int]]:
    """Reflectors that are closer than ``separation`` [m]."""
    gap = np.hypot(*(points[:, None] - points).transpose(2, 0, 1))
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(gap < separation, 1))]
