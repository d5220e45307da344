# SPDX-License-Identifier: Apache-2.0
"""Robust losses rho(s) of the squared Mahalanobis norm s = e^T I e.

With k = scale (in sigmas), rho(s) ~ s for small s and the weight is w = d rho / d s:

* none             rho = s
* huber            rho = s for s <= k^2, else 2 k sqrt(s) - k^2
* cauchy           rho = k^2 log(1 + s / k^2)
* geman_mcclure    rho = s / (1 + s / k^2)
* dcs              w = min(1, 2 k^2 / (k^2 + s))^2, the dynamic covariance scaling of
                   Agarwal et al. 2013 (phi = k^2), and rho its integral
* truncated        rho = min(s, k^2)

The cost that the solver minimises is the sum of rho over the enabled factors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from rlml_slam.compiled import brief, kernel
from rlml_slam.errors import SolverError
from rlml_slam.se2 import Array


class LossKind(IntEnum):
    """The losses; the values are the codes of the kernels."""

    NONE = 0
    HUBER = 1
    CAUCHY = 2
    GEMAN_MCCLURE = 3
    DCS = 4
    TRUNCATED = 5


@dataclass(frozen=True)
class Loss:
    """A loss and its scale in sigmas: from about there on a residual counts less."""

    kind: LossKind = LossKind.NONE
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Refuse a scale that is not positive."""
        if not (math.isfinite(self.scale) and self.scale > 0.0):
            raise SolverError(f'scale {self.scale!r} of loss {self.kind.name.lower()} is not > 0')


@kernel
def loss(kind: int, scale: float, s: float) -> tuple[float, float]:
    """(rho, w) of the squared norm ``s``."""
    if kind == 0:
        return s, 1.0
    k2 = scale * scale
    if kind == 1:
        if s <= k2:
            return s, 1.0
        root = math.sqrt(s)
        return 2.0 * scale * root - k2, scale / root
    if kind == 2:
        return k2 * math.log1p(s / k2), k2 / (k2 + s)
    if kind == 3:
        w = k2 / (k2 + s)
        return s * w, w * w
    if s <= k2:
        return s, 1.0
    if kind == 4:
        w = 2.0 * k2 / (k2 + s)
        return k2 * (3.0 * s - k2) / (s + k2), w * w
    return k2, 0.0


@brief
def weights(kind: int, scale: float, s: Array) -> Array:
    """W (n,) of squared norms ``s`` (n,)."""
    out = np.empty(len(s))
    for i in range(len(s)):
        out[i] = loss(kind, scale, s[i])[1]
    return out


def warm_up() -> None:
    """Compile the kernels."""
    weights(0, 1.0, np.zeros(1))
