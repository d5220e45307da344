# SPDX-License-Identifier: Apache-2.0
"""Which end points of a scan lie on walls that a submap saw from the same side.

End points do not say which side of a wall they are on. Where corridors cross, a robot that drives
back sees the other sides of the crossing's walls: one of them lies a corridor's width from the
other, and a match displaced by that width fits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.se2 import Array

# [m] before an end point, along its beam, and [m] the size of the cells that this is meant for
FRONT, CELL = np.array([0.2, 0.3, 0.4]), 0.05
MOST = 2  # of these places: at as many at least the submap knows something
WEAK = 1e-2 * np.eye(2)  # [1/m²] of what nothing holds


def of_seen_sides(submap: Submap, points: Array, origin: Array, pose: Array) -> NDArray[np.bool_]:
    """Whether the submap knows what is before each end point, with the base at ``pose`` (3,).

    ``points`` (n, 2) and ``origin`` (2,), the laser's place, are in the base frame.
    """
    laser = se2.transform(pose, origin[None])[0]
    ends = se2.transform(pose, points)
    back = laser - ends
    far = np.maximum(np.hypot(back[:, 0], back[:, 1]), CELL)
    # no place is behind the laser
    before = np.minimum(FRONT * max(1.0, submap.resolution / CELL), far[:, None])
    places = ends[:, None] + (before / far[:, None])[..., None] * back[:, None]
    cells = np.floor(places / submap.resolution).astype(np.int64) - submap.corner
    # far from the laser, its beams leave cells out between them
    reach = int(CELL / submap.resolution)
    around = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(around, around), -1).reshape(-1, 2)
    return np.asarray(_is_known(submap, cells[:, :, None] + offsets).any(-1).sum(-1) >= MOST)


def _is_known(submap: Submap, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether something is known of cells (..., 2), column and row of the values."""
    inside = np.asarray(((cells >= 0) & (cells < submap.values.shape[::-1])).all(-1))
    if not inside.any():
        return inside
    column, row = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
    return np.asarray(inside & (submap.values[row, column] != 0))


def least_share(part: Array, whole: Array) -> float:
    """Share of the information ``part`` in ``whole`` (3, 3), in the direction of the least."""
    root = np.linalg.inv(np.linalg.cholesky(_of_position(whole)))
    return float(np.linalg.eigvalsh(root @ _of_position(part) @ root.T)[0])


def _of_position(information: Array) -> Array:
    """Information (2, 2) of the position, with the heading unknown."""
    H = information
    out: Array = H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / max(H[2, 2], 1e-9) + WEAK
    return out
