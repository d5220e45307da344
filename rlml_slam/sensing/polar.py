# SPDX-License-Identifier: Apache-2.0
"""Covariance of points that were measured by range and bearing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rlml_slam.se2 import Array


def polar_covariance(u: Array, along: ArrayLike, across: Array) -> Array:
    """Covariances s_r^2 u u^T + (r s_b)^2 t t^T (n, 2, 2), t normal to the directions u (n, 2).

    ``along`` (n,) or one is s_r^2, ``across`` (n,) is (r s_b)^2 [m^2].
    """
    t = np.stack([-u[:, 1], u[:, 0]], -1)
    cov: Array = np.asarray(along)[..., None, None] * u[:, :, None] * u[:, None, :]
    cov += across[:, None, None] * t[:, :, None] * t[:, None, :]
    return cov
