# SPDX-License-Identifier: Apache-2.0
"""Scans among walls, without noise."""

import numpy as np

from rlml_slam import se2
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.simulation.world import Geometry


def end_points(pose, walls, view, reach, origin=(0.0, 0.0)):
    """End points (n, 2) in base at ``pose`` (3,), of beams at ``view`` [rad] from ``origin``."""
    segments = np.hstack([np.array(walls), np.zeros((len(walls), 2))])
    geometry = Geometry(segments, np.zeros((0, 5)), np.zeros((len(walls), 4)))
    x, y, heading = se2.compose(pose, np.array([*origin, 0.0]))
    n = len(view)
    r, _, _ = cast(np.tile((x, y), (n, 1)), heading + view, np.zeros(n), geometry, reach)
    hit = np.isfinite(r)
    return origin + r[hit, None] * np.stack([np.cos(view[hit]), np.sin(view[hit])], -1)
