# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid that is published and saved: rendered from keyframe scans by ray carving."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    if not any(map(len, points)):
        return OccupancyGrid(resolution, (0.0, 0.0), np.full((1, 1), UNKNOWN, dtype=np.int8))
    # one keyframe after the other: all end points at once would be the largest array of a site
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for start, end in _beams(poses, points, origins):
        low = np.minimum(low, np.minimum(end.min(0), start))
        high = np.maximum(high, np.maximum(end.max(0), start))
    low = np.floor(low / resolution) - 1.0
    high = np.floor(high / resolution) + 2.0
    columns, rows = float(high[0] - low[0]), float(high[1] - low[1])
    if not columns * rows <= MAX_CELLS:
        raise MapError(f'map of {columns:.0f} x {rows:.0f} cells is too large to be drawn')
    hits = np.zeros((int(rows), int(columns)), dtype=np.int32)
    visits = np.zeros_like(hits)
    for start, end in _beams(poses, points, origins):
        begin = np.repeat((start / resolution - low)[None], len(end), axis=0)
        count_beams(hits, visits, begin, end / resolution - low)
    cells = np.full(hits.shape, UNKNOWN, dtype=np.int8)
    for row in range(len(cells)):
        seen = visits[row] > 0
        share = hits[row, seen] / visits[row, seen]
        cells[row, seen] = np.minimum(np.rint(share * (50.0 / occupied_share)), 100.0)
    origin = (float(low[0]) * resolution, float(low[1]) * resolution)
    return OccupancyGrid(resolution, origin, cells)


def _beams(
    poses: Array, points: Sequence[NDArray[np.floating[Any]]], origins: Sequence[Array]
) -> Iterator[tuple[Array, Array]]:
    """Sensor (2,) and end points (n, 2) in the map of each keyframe that has a scan."""
    for pose, p, o in zip(poses, points, origins, strict=True):
        if len(p):
            yield transform(pose, np.reshape(o, (1, 2)))[0], transform(pose, p)


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
