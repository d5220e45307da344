# SPDX-License-Identifier: Apache-2.0
"""RANSAC lines of a scan, with the note's five parameters N, S, D, X and C.

A line is (rho, alpha): distance and direction of its perpendicular from the origin of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Ransac
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Lines:
    """``lines`` (k, 2) = (rho >= 0 [m], alpha [rad]), ``cov`` (k, 2, 2), readings of each (k,).

    ``ends`` (k, 2, 2) are the outermost readings, projected onto the line.
    """

    lines: Array
    cov: Array
    readings: NDArray[np.int64]
    ends: Array


def extract(points: Array, origin: Array, params: Ransac) -> Lines:
    """Lines among the end points (n, 2) of one sweep, in their order; ``origin`` (2,): the laser.

    Deterministic: the same points and seed give the same lines.
    """
    rng = np.random.default_rng(params.seed)
    angle = np.arctan2(points[:, 1] - origin[1], points[:, 0] - origin[0])
    order = np.argsort(angle, kind='stable')
    p, angle = np.asarray(points, dtype=np.float64)[order], angle[order]
    rows = []
    for _ in range(params.max_trials):  # N
        if len(p) < params.consensus:
            break
        members = _trial(p, angle, params, rng)
        if members is None:
            continue
        line = _line(p[members], params)
        if line is not None:
            rows.append(line)
        keep = np.ones(len(p), dtype=np.bool_)
        keep[members] = False
        p, angle = p[keep], angle[keep]
    if not rows:
        return Lines(
            np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros((0, 2, 2))
        )
    lines, covs, readings, ends = zip(*rows, strict=True)
    return Lines(np.array(lines), np.array(covs), np.array(readings), np.array(ends))


def _trial(
    p: Array, angle: Array, params: Ransac, rng: np.random.Generator
) -> NDArray[np.int64] | None:
    """Readings of one line that reaches the consensus, None if this trial finds none."""
    n = len(p)
    first = int(rng.integers(n))
    # readings within D of the first one; the order is by angle
    low = int(np.searchsorted(angle, angle[first] - params.sample_angle))
    high = int(np.searchsorted(angle, angle[first] + params.sample_angle, side='right'))
    if high - low <= params.samples:
        return None
    sample = np.append(rng.integers(low, high, params.samples), first)
    rho, normal = _fit(p[sample])
    near = np.abs(p @ normal - rho) <= params.tolerance
    if int(near.sum()) < params.consensus:
        return None
    # least squares again, with all readings on the old line
    rho, normal = _fit(p[near])
    members = np.flatnonzero(np.abs(p @ normal - rho) <= params.tolerance)
    members = _together(p, members, normal, first, params.max_gap)
    return members if len(members) >= params.consensus else None


def _together(
    p: Array, members: NDArray[np.int64], normal: Array, first: int, max_gap: float
) -> NDArray[np.int64]:
    """The part without gaps that holds the first reading: a wall, not all that is in its line."""
    along = p[members] @ np.array([-normal[1], normal[0]])
    order = np.argsort(along, kind='stable')
    part = np.concatenate([[0], np.cumsum(np.diff(along[order]) > max_gap)])
    parts = np.empty(len(members), dtype=np.int64)
    parts[order] = part
    here = np.flatnonzero(members == first)
    if not len(here):
        return members[:0]
    out: NDArray[np.int64] = members[parts == parts[here[0]]]
    return out


def _fit(p: Array) -> tuple[float, Array]:
    """Total least squares line: distance of the origin (of either sign) and unit normal (2,)."""
    mean = p.mean(axis=0)
    d = p - mean
    xx, xy, yy = d[:, 0] @ d[:, 0], d[:, 0] @ d[:, 1], d[:, 1] @ d[:, 1]
    a = 0.5 * np.arctan2(-2.0 * xy, yy - xx)
    normal = np.array([np.cos(a), np.sin(a)])
    return float(mean @ normal), normal


def _line(p: Array, params: Ransac) -> tuple[Array, Array, int, Array] | None:
    """(rho, alpha), its covariance, number of readings and ends; None where it is too short."""
    rho, normal = _fit(p)
    if rho < 0.0:
        rho, normal = -rho, -normal
    t = np.array([-normal[1], normal[0]])
    along = p @ t
    low, high = float(along.min()), float(along.max())
    if high - low < params.min_length:
        return None
    n, middle = len(p), float(along.mean())
    # across = rho' + (along - middle) turn: the two errors are independent at the middle
    var_d = params.sigma**2 / n
    var_a = params.sigma**2 / float(((along - middle) ** 2).sum())
    floor = np.array(params.sigma_floor) ** 2
    var_d, var_a = var_d + floor[0], var_a + floor[1]
    # turning by da about the middle moves the perpendicular's foot: drho = -middle da ... (+)
    J = np.array([[1.0, middle], [0.0, 1.0]])
    cov = J @ np.diag([var_d, var_a]) @ J.T
    ends = rho * normal + np.array([[low], [high]]) * t
    return np.array([rho, np.arctan2(normal[1], normal[0])]), cov, n, ends


def nearest_point(lines: Array, fixed: Array) -> Array:
    """The note's step from line to landmark: each line's point (k, 2) nearest to ``fixed`` (2,).

    Lines (k, 2) as above; both in one frame.
    """
    n = np.stack([np.cos(lines[:, 1]), np.sin(lines[:, 1])], -1)
    out: Array = fixed + (lines[:, 0] - n @ fixed)[:, None] * n
    return out


def range_and_bearing(points: Array, pose: Array) -> Array:
    """Range and bearing (k, 2) of map points (k, 2) from the robot's pose (3,)."""
    d = points - pose[:2]
    bearing = np.arctan2(d[:, 1], d[:, 0]) - pose[2]
    wrapped = np.pi - np.mod(np.pi - bearing, 2.0 * np.pi)
    return np.stack([np.hypot(d[:, 0], d[:, 1]), wrapped], -1)
