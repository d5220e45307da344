# SPDX-License-Identifier: Apache-2.0
"""Two laps of a circle by odometry alone: a graph whose drift only loop closures take away."""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.types import EdgeKind

LAP, STEP = 80, 0.25  # poses of a circle, [m] between two
SIGMA = np.array([0.02, 0.02, 0.005])  # [m, m, rad] of a step
COV = np.diag(SIGMA**2)


def true(k):
    """True pose (..., 3) of the poses with these numbers."""
    phi = 2.0 * np.pi * np.asarray(k) / LAP
    radius = STEP * LAP / (2.0 * np.pi)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), se2.wrap(phi + np.pi / 2.0)], -1)


def two_laps(rng):
    """The graph, with the noise of its odometry."""
    out = Graph()
    out.add_pose(true(0), fixed=True)
    for k in range(1, 2 * LAP):
        delta = se2.compose(se2.between(true(k - 1), true(k)), SIGMA * rng.standard_normal(3))
        out.add_pose(se2.compose(out.poses[-1], delta))
        out.add_edge(EdgeKind.ODOMETRY, k - 1, k, delta, np.diag(SIGMA**-2))
    return out
