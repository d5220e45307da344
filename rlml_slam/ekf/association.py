# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbour in Mahalanobis distance with the validation gate nu^T S^-1 nu <= lambda."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS


def mahalanobis2(nu: Array, S: Array) -> Array:
    """nu^T S^-1 nu over leading dimensions, 2 x 2 in closed form."""
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    a, b = nu[..., 0], nu[..., 1]
    return (
        S[..., 1, 1] * a * a - (S[..., 0, 1] + S[..., 1, 0]) * a * b + S[..., 0, 0] * b * b
    ) / det


def compatible_ids(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(k, m): ids are equal, or one of them is anonymous."""
    x, y = a[:, None], b[None, :]
    out: NDArray[np.bool_] = (x == y) | (x == ANONYMOUS) | (y == ANONYMOUS)
    return out


def nearest(distance2: Array, gate: float) -> NDArray[np.int64]:
    """(k,): each detection's nearest landmark inside the gate, -1 for none.

    ``distance2`` (k, m), infinite where a pair is impossible. Where two detections share a nearest
    landmark, the nearer one has it and the other has none: one landmark is seen once per scan.
    """
    k, m = distance2.shape
    match = np.full(k, -1, dtype=np.int64)
    if not k or not m:
        return match
    best = distance2.argmin(axis=1)
    d = distance2[np.arange(k), best]
    taken = np.zeros(m, dtype=np.bool_)
    for i in np.argsort(d, kind='stable'):
        if d[i] <= gate and not taken[best[i]]:
            match[i] = best[i]
            taken[best[i]] = True
    return match
