# SPDX-License-Identifier: Apache-2.0
"""Pairs of mapped reflectors that are one, by their distance and joint covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from rlml_slam.estimation.landmark_merging import MERGE_DISTANCE, MergeTest
from rlml_slam.graph import OnlineSolver
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.landmark import Landmark


def find_same(
    solver: OnlineSolver, alive: Sequence[Landmark], test: MergeTest
) -> list[tuple[Landmark, Landmark]]:
    """Pairs that are close, statistically equal and never seen together, each reflector once."""
    points = solver.graph.landmarks[[m.index for m in alive]]
    if len(alive) < 2:
        return []
    pairs = cKDTree(points).query_pairs(MERGE_DISTANCE, output_type='ndarray')
    distinct = [alive[i].is_distinct(alive[j]) for i, j in pairs.tolist()]
    pairs = pairs[~np.array(distinct, dtype=np.bool_)]
    if not len(pairs):
        return []
    gaps = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], gaps))
    close = np.unique(pairs)
    joint = solver.joint([], [alive[k].index for k in close])
    merged: set[int] = set()
    out = []
    for (i, j), gap in zip(pairs[order].tolist(), gaps[order].tolist(), strict=True):
        if i in merged or j in merged:
            continue
        cov = _difference_cov(joint, *np.searchsorted(close, (i, j)))
        if test.is_same(points[i] - points[j], gap, cov):
            out.append((alive[i], alive[j]))
            merged |= {i, j}
    return out


def _difference_cov(joint: Array, a: int, b: int) -> Array:
    """Covariance (2, 2) of landmark a minus landmark b, from a ``joint`` one (2m, 2m)."""
    rows = np.array([2 * a, 2 * a + 1, 2 * b, 2 * b + 1])
    D = np.hstack([np.eye(2), -np.eye(2)])
    cov: Array = D @ joint[np.ix_(rows, rows)] @ D.T
    return cov
