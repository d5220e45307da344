# SPDX-License-Identifier: Apache-2.0
"""Were the sensors of two runs mounted alike? What their paths say, by hand-eye calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.se2 import Array

STEP = 2_000_000_000  # [ns] of a motion: long enough to turn, short against drift
MIN_MOTIONS = 10
ITERATIONS = 20
TUNING = 2.385  # of Cauchy's weight: 95 % as efficient as least squares for normal errors
MEDIAN_RAYLEIGH = 1.1774  # median length of a vector of two unit normals


@dataclass(frozen=True)
class Mounting:
    """How the sensors of B sit against those of A, to first order.

    ``shift`` (3,): x, y [m] and heading [rad] in the base frame, with its ``sigma`` (3,).
    """

    shift: Array
    sigma: Array

    def is_certain(self, sigmas: float = 5.0) -> bool:
        """Whether the shift is more than its noise."""
        return bool((np.abs(self.shift) > sigmas * self.sigma).any())


def mounting_difference(stamps: NDArray[np.int64], a: Array, b: Array) -> Mounting | None:
    """The shift that explains best how poses a and b (n, 3) at the same stamps (n,) differ.

    If the base of B sits at X in the base of A, motions obey M_b = X^-1 M_a X. To first order in
    X = (x, phi), with M_a = (t_a, R_a) and the perpendicular J:

        t_b - t_a = (R_a - I) x - phi J t_a

    which is solved over motions of two seconds by least squares with Cauchy's weights (two paths
    also drift apart). Sensors that sit the other way round give the base: the shift is -X. None
    where the robot did not move or turn; where it turned little, the sigmas are large.
    """
    ends = np.unique(np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], STEP)))
    M_a, M_b = (se2.between(p[ends[:-1]], p[ends[1:]]) for p in (a, b))
    if len(ends) <= MIN_MOTIONS or not np.isfinite([M_a, M_b]).all():
        return None
    rows = np.empty((len(M_a), 2, 3))
    rows[:, :, :2] = se2.rotation(M_a[:, 2]) - np.eye(2)
    rows[:, 0, 2], rows[:, 1, 2] = M_a[:, 1], -M_a[:, 0]
    wanted = (M_b - M_a)[:, :2]
    weights, X, scale, H = np.ones(len(rows)), np.zeros(3), 0.0, np.eye(3)
    for _ in range(ITERATIONS):
        H = np.einsum('n,nij,nik->jk', weights, rows, rows)
        if np.linalg.cond(H) > 1e12:
            return None
        X = np.linalg.solve(H, np.einsum('n,nij,ni->j', weights, rows, wanted))
        error = np.linalg.norm(wanted - rows @ X, axis=1)
        scale = max(float(np.median(error)) / MEDIAN_RAYLEIGH, 1e-7)
        weights = 1.0 / (1.0 + (error / (TUNING * scale)) ** 2)
    return Mounting(-X, np.sqrt(np.diag(scale**2 * np.linalg.inv(H))))
