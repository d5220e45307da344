# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid that is published and saved: rendered from keyframe scans by ray carving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.errors import MapError
from rlml_slam.se2 import Array, transform

UNKNOWN = -1
MAX_CELLS = 400_000_000  # a larger grid is a mistake in the poses, not a map


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """``cells`` (rows = y, columns = x) int8: -1 unknown, 0 free .. 100 occupied.

    ``origin`` (x, y) [m]: the lower left corner of cells[0, 0] in the map frame, about which the
    grid is turned by ``yaw`` [rad]; ``resolution`` [m].
    """

    resolution: float
    origin: tuple[float, float]
    cells: NDArray[np.int8]
    yaw: float = 0.0

    @property
    def T_map_grid(self) -> Array:
        """Pose (3,) of the grid's corner and axes in the map frame."""
        return np.array([*self.origin, self.yaw])


def render(
    poses: Array,
    points: Sequence[NDArray[np.floating[Any]]],
    origins: Sequence[Array],
    resolution: float = 0.05,
    occupied_share: float = 0.25,
) -> OccupancyGrid:
    """The grid of keyframes: ``poses`` (n, 3) in the map, end points and sensor in their frames.

    A cell counts the beams that end in it (hits) and that cross it (misses). It is unknown
    without either; else its value is 50 hits / (visits occupied_share), at most 100, so that
    a cell is occupied from ``occupied_share`` of hits on: beams that graze a wall cross its
    cells more often than they end there. Raises MapError if the poses spread the grid too wide.
    """
    ends, starts, counts = [], [], []
    for pose, p, o in zip(poses, points, origins, strict=True):
        if len(p):
            ends.append(transform(pose, p))
            starts.append(transform(pose, np.reshape(o, (1, 2))))
            counts.append(len(p))
    if not ends:
        return OccupancyGrid(resolution, (0.0, 0.0), np.full((1, 1), UNKNOWN, dtype=np.int8))
    end = np.concatenate(ends)
    start = np.repeat(np.concatenate(starts), counts, axis=0)
    low = np.floor(np.minimum(end.min(0), start.min(0)) / resolution) - 1.0
    high = np.floor(np.maximum(end.max(0), start.max(0)) / resolution) + 2.0
    columns, rows = float(high[0] - low[0]), float(high[1] - low[1])
    if not columns * rows <= MAX_CELLS:
        raise MapError(f'map of {columns:.0f} x {rows:.0f} cells is too large to be drawn')
    hits = np.zeros((int(rows), int(columns)), dtype=np.int32)
    visits = np.zeros_like(hits)
    count_beams(hits, visits, start / resolution - low, end / resolution - low)
    share = hits / np.maximum(visits, 1)
    value = np.minimum(np.rint(share * (50.0 / occupied_share)), 100.0)
    cells = np.where(visits == 0, UNKNOWN, value).astype(np.int8)
    origin = (float(low[0]) * resolution, float(low[1]) * resolution)
    return OccupancyGrid(resolution, origin, cells)


@kernel
def count_beams(
    hits: NDArray[np.int32], visits: NDArray[np.int32], start: Array, end: Array
) -> None:
    """Count per cell the beams that end in it and that touch it; coordinates in cells."""
    for k in range(len(end)):
        x0, y0, x1, y1 = start[k, 0], start[k, 1], end[k, 0], end[k, 1]
        j, i = int(np.floor(x0)), int(np.floor(y0))
        end_j, end_i = int(np.floor(x1)), int(np.floor(y1))
        dx, dy = x1 - x0, y1 - y0
        step_j = 1 if dx > 0 else -1
        step_i = 1 if dy > 0 else -1
        per_j = 1.0 / abs(dx) if dx != 0 else np.inf
        per_i = 1.0 / abs(dy) if dy != 0 else np.inf
        next_j = ((j + 1 - x0) if dx > 0 else (x0 - j)) * per_j if dx != 0 else np.inf
        next_i = ((i + 1 - y0) if dy > 0 else (y0 - i)) * per_i if dy != 0 else np.inf
        for _ in range(abs(end_j - j) + abs(end_i - i)):
            visits[i, j] += 1
            if next_j < next_i:
                j += step_j
                next_j += per_j
            else:
                i += step_i
                next_i += per_i
        visits[end_i, end_j] += 1
        hits[end_i, end_j] += 1


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    render(np.zeros((1, 3)), [np.array([[1.0, 0.5]])], [np.zeros(2)])
