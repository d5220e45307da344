# SPDX-License-Identifier: Apache-2.0
"""Which reflectors a place sees: light goes both ways, so each reflector casts one fan of rays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.params import Detector, Parameters, SimulatorParameters
from rlml_slam.planning.site import Site
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.spot_edges import GAP
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.simulation.world import Geometry, ReflectorSet

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
    ``min_separation``, the detector sees one; of two that are one bright spot, none.
    """
    r = site.reflectors
    seen = in_sight(places, r, site.walls.joined(r.geometry()), p, sensor)
    for a, b in close_pairs(r.points, p.reflector.min_separation):
        seen[:, b] &= ~seen[:, a]
    remove_merged(seen, places, r, sensor)
    return seen


def in_sight(
    places: Array, r: ReflectorSet, geometry: Geometry, p: Parameters, sensor: SimulatorParameters
) -> NDArray[np.bool_]:
    """Whether nothing of ``geometry`` hides each reflector (n, m) from each place (n, 2)."""
    reach = max_range(p, sensor)
    seen = np.zeros((len(places), len(r)), dtype=np.bool_)
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
    return seen


def remove_merged(
    seen: NDArray[np.bool_], places: Array, r: ReflectorSet, sensor: SimulatorParameters
) -> None:
    """Neighbours about as far away with fewer than two dark beams between them are one spot.

    It is too wide for a reflector, so that the detector takes neither.
    """
    if len(r) < 2:
        return
    n, detector = sensor.laser, Detector()
    step = n.field_of_view / n.beams
    size = max(detector.diameter, detector.flat_width)
    depth = size + detector.size_tolerance + 3.0 * detector.sigma_range
    reach = sensor.markers.max_range
    across = float(r.widths.max()) + max(2.0 * step * reach, GAP) + n.divergence * reach
    for a, b in cKDTree(r.points).query_pairs(math.hypot(depth, across)):
        both = np.flatnonzero(seen[:, a] & seen[:, b])
        d = r.points[[a, b]] - places[both, None]
        ranges = np.hypot(d[..., 0], d[..., 1])
        turn = np.abs(se2.wrap(np.subtract(*np.arctan2(d[..., 1], d[..., 0]).T)))
        mean = ranges.mean(axis=1)
        dark = mean * (turn - n.divergence) - 0.5 * (r.widths[a] + r.widths[b])
        one = dark < np.maximum(2.0 * step * mean, GAP)
        one &= np.abs(np.subtract(*ranges.T)) <= depth
        seen[np.ix_(both[one], [a, b])] = False


def close_pairs(points: Array, separation: float) -> list[tuple[int, int]]:
    """Reflectors that are closer than ``separation`` [m]."""
    gap = np.hypot(*(points[:, None] - points).transpose(2, 0, 1))
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(gap < separation, 1))]
