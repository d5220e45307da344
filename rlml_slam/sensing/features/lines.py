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
from rlml_slam.sensing.features.ransac import find_lines, fit


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
    p = np.asarray(points, dtype=np.float64)
    angle = np.arctan2(p[:, 1] - origin[1], p[:, 0] - origin[0])
    order = np.argsort(angle, kind='stable')
    p = p[order]
    draws = np.random.default_rng(params.seed).random((params.max_trials, 1 + params.samples))
    line_of = find_lines(
        p, angle[order], draws, params.sample_angle, params.tolerance, params.consensus,
        params.max_gap,
    )  # fmt: skip
    found = (
        _line(p, np.flatnonzero(line_of == k), params) for k in range(line_of.max(initial=-1) + 1)
    )
    rows = [line for line in found if line is not None]
    if not rows:
        return Lines(
            np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros((0, 2, 2))
        )
    lines, covs, readings, ends = zip(*rows, strict=True)
    return Lines(np.array(lines), np.array(covs), np.array(readings), np.array(ends))


def _line(
    points: Array, members: NDArray[np.int64], params: Ransac
) -> tuple[Array, Array, int, Array] | None:
    """(rho, alpha), its covariance, number of readings and ends; None where it is too short."""
    rho, alpha = fit(points, members)
    p, normal = points[members], np.array([np.cos(alpha), np.sin(alpha)])
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
