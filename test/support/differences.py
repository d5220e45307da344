# SPDX-License-Identifier: Apache-2.0
"""Central differences, which every analytic Jacobian is checked against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def central_differences(
    function: Callable[[Array], Array], at: Array, step: float = 1e-6, angles: tuple[int, ...] = ()
) -> Array:
    """Jacobian (m, n) of ``function`` (n,) -> (m,) at ``at``.

    ``angles`` are outputs whose difference is taken modulo 2 pi. The truncation error is
    step^2 f'''/6 and the rounding error eps |f| / step, so about 1e-9 for values near 1.
    """
    at = np.asarray(at, dtype=np.float64)
    columns = []
    for k in range(len(at)):
        shift = np.zeros_like(at)
        shift[k] = step
        difference = np.asarray(function(at + shift)) - np.asarray(function(at - shift))
        for a in angles:
            difference[a] = (difference[a] + np.pi) % (2.0 * np.pi) - np.pi
        columns.append(difference / (2.0 * step))
    return np.stack(columns, -1)
