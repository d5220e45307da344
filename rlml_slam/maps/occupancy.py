# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid that is published and saved: rendered from keyframe scans by ray carving."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.se2 import Array, transform

UNKNOWN = -1
OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196  # below the 50/255 of an unknown pixel, which 0.25 would read as free
PGM_OCCUPIED, PGM_UNKNOWN, PGM_FREE = 0, 205, 254
MAX_CELLS = 400_000_000  # a larger grid is a mistake in the poses, not a map


@dataclass(frozen=True)
class OccupancyGrid:
    """``cells`` (rows = y, columns = x) int8: -1 unknown, 0 free .. 100 occupied.

    ``origin`` (x, y) [m]: the lower left corner of cells[0, 0] in the map frame;
    ``resolution`` [m].
    """

    resolution: float
    origin: tuple[float, float]
    cells: NDArray[np.int8]


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


def save(grid: OccupancyGrid, path: str | Path) -> tuple[Path, Path]:
    """Write ``path``.pgm and ``path``.yaml (nav2's convention, trinary); the two paths.

    Each file appears whole or not at all. A cell of 65 or more is occupied, of 19 or less free.
    Raises MapError if the folder cannot be written.
    """
    base = Path(path)
    pgm, meta = base.with_name(base.name + '.pgm'), base.with_name(base.name + '.yaml')
    image = np.full(grid.cells.shape, PGM_UNKNOWN, dtype=np.uint8)
    image[(grid.cells >= 0) & (grid.cells <= 100 * FREE_THRESH)] = PGM_FREE
    image[grid.cells >= 100 * OCCUPIED_THRESH] = PGM_OCCUPIED
    rows = len(image)
    columns = image.size // max(rows, 1)
    header = f'P5\n# resolution {grid.resolution:g} m\n{columns} {rows}\n255\n'.encode()
    text = (
        f'image: {pgm.name}\nmode: trinary\nresolution: {grid.resolution!r}\n'
        f'origin: [{grid.origin[0]!r}, {grid.origin[1]!r}, 0.0]\nnegate: 0\n'
        f'occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n'
    )
    write_atomically(pgm, header + image[::-1].tobytes())
    write_atomically(meta, text.encode())
    return pgm, meta


def load(path: str | Path) -> OccupancyGrid:
    """The grid of a nav2 map: ``path`` is the .yaml file. Cells are -1, 0 or 100.

    Raises MapError if a file is missing, FileFormatError if one is malformed.
    """
    path = Path(path)
    try:
        meta = yaml.safe_load(path.read_text(encoding='utf-8'))
        image_path = path.parent / str(meta['image'])
        resolution, negate = float(meta['resolution']), int(meta.get('negate', 0))
        x, y, _ = (float(v) for v in meta['origin'])
        occupied, free = float(meta['occupied_thresh']), float(meta['free_thresh'])
        data = image_path.read_bytes()
    except OSError as e:
        raise MapError(f'{e.filename}: cannot be read: {e.strerror}') from e
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as e:
        raise FileFormatError(f'{path}: not a map description: {e}') from e
    if not (resolution > 0.0 and math.isfinite(resolution + x + y)):
        raise FileFormatError(f'{path}: resolution or origin is not usable')
    share = parse_pgm(data, image_path) / 255.0
    p = share if negate else 1.0 - share
    cells = np.full(p.shape, UNKNOWN, dtype=np.int8)
    cells[p < free] = 0
    cells[p > occupied] = 100
    return OccupancyGrid(resolution, (x, y), np.ascontiguousarray(cells[::-1]))


def parse_pgm(data: bytes, path: Path) -> NDArray[np.uint8]:
    """Image (rows from the top, columns) of a binary PGM with 255 grey values."""
    head = re.match(rb'P5(?:\s+#[^\n]*)*\s+(\d+)(?:\s+#[^\n]*)*\s+(\d+)\s+255\s', data)
    if head is None:
        raise FileFormatError(f'{path}: not a binary PGM image of 8 bits')
    columns, rows = int(head[1]), int(head[2])
    body = np.frombuffer(data, dtype=np.uint8, offset=head.end())
    if len(body) != rows * columns:
        raise FileFormatError(f'{path}: {len(body)} pixels, {columns} x {rows} expected')
    return body.reshape(rows, columns)


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    render(np.zeros((1, 3)), [np.array([[1.0, 0.5]])], [np.zeros(2)])
