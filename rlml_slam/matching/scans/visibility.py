# SPDX-License-Identifier: Apache-2.0
"""Which end points of a scan lie behind walls of a submap, where the laser could not see them.

End points alone do not say from where they were seen. Beside a corridor, in rooms that the submap
does not know, a scan of the corridor fits as well: then its beams pass through a wall.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import kernel, part
from rlml_slam.matching.scans.ray_carving import Grid
from rlml_slam.matching.scans.submap import Submap, value_of
from rlml_slam.se2 import Array

WALL = value_of(np.array(0.6)).item()  # of a cell that was hit more often than not
OWN = 0.2  # [m] around the laser: the robot stands there
FINE = 2  # steps per cell: between the corners of diagonal cells there is no gap
BEHIND = 0.5  # [m] from the wall to the end point at least: less may be the error of the map
# [m] to both sides of a beam, where the wall is as well: a wall along it or a chair is not
ASIDE = 0.15


def hidden_share(submap: Submap, points: Array, origin: Array, pose: Array) -> float:
    """Share of the end ``points`` (n, 2) behind walls, with the base at ``pose`` (3,) of the grid.

    ``origin`` (2,) is the laser's place; both are in the base frame.
    """
    ends = se2.transform(pose, np.asarray(points, dtype=np.float64))
    aside = max(ASIDE, 2.0 * submap.resolution)
    hidden = count_hidden(submap.grid, aside, se2.transform(pose, origin[None])[0], ends)
    return hidden / max(len(points), 1)


@kernel
def count_hidden(grid: Grid, aside: float, origin: Array, ends: Array) -> int:
    """How many beams from ``origin`` (2,) to ``ends`` (n, 2) pass through a wall."""
    values, corner_j, corner_i, scale = grid
    count = 0
    for k in range(len(ends)):
        dx, dy = ends[k, 0] - origin[0], ends[k, 1] - origin[1]
        far = math.hypot(dx, dy)
        first, end = int(OWN * scale * FINE), int((far - BEHIND) * scale * FINE)
        if first >= end:
            continue
        dx, dy = dx / far, dy / far
        is_hidden = True
        for side in range(-1, 2):
            x = (origin[0] - side * aside * dy) * scale - corner_j
            y = (origin[1] + side * aside * dx) * scale - corner_i
            is_hidden = is_hidden and crosses(values, x, y, dx / FINE, dy / FINE, first, end)
        count += int(is_hidden)
    return count


@part
def crosses(
    values: NDArray[np.uint16], x: float, y: float, dx: float, dy: float, first: int, end: int
) -> bool:
    """Whether a beam from (x, y), in cells, meets a wall from step ``first`` to ``end``."""
    rows, columns = values.shape
    for step in range(first, end):
        j, i = math.floor(x + step * dx), math.floor(y + step * dy)
        if 0 <= i < rows and 0 <= j < columns and values[i, j] > WALL:
            return True
    return False


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    submap.insert(np.array([[1.0, 0.5], [-0.5, 1.0]]), np.zeros(2))
    hidden_share(submap, submap.walls(), np.zeros(2), np.zeros(3))
