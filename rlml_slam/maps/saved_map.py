# SPDX-License-Identifier: Apache-2.0
"""A map as it is saved and loaded: reflectors and a grid; its text files."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rlml_slam.errors import MapError, NoMapError, RlmlError
from rlml_slam.maps import nav2_map, reflector_file
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.types import Reflectors

ID_DIGITS = 12
NOT_YET = 'there is no map yet: drive through the place first'
EMPTY = 'the map is empty: it has no grid and no reflectors'


@dataclass(frozen=True)
class SavedMap:
    """Reflectors and, where scans were used, the grid."""

    reflectors: Reflectors
    grid: OccupancyGrid | None = None

    @cached_property
    def id(self) -> str:
        """The same for equal maps: 12 hexadecimal digits of SHA-256 of reflectors and grid.

        Computed from what a robot localizes with, as it survives the way over topics.
        """
        content = hashlib.sha256()
        r, grid = self.reflectors, self.grid
        for array in (r.keys.astype('<i4'), r.ids.astype('<i4'), r.points.astype('<f8')):
            content.update(np.ascontiguousarray(array).tobytes())
        if grid is not None:
            lattice = np.array([*grid.origin, grid.yaw, grid.resolution], dtype='<f4')
            content.update(repr(grid.cells.shape).encode() + lattice.tobytes())
            content.update(np.ascontiguousarray(grid.cells).data)
        return content.hexdigest()[:ID_DIGITS]


def require_contents(saved: SavedMap, why: str = NOT_YET) -> SavedMap:
    """The map itself; MapError, which says ``why``, where there is nothing in it."""
    if saved.grid is None and len(saved.reflectors) == 0:
        raise MapError(why)
    return saved


def require_reflectors(saved: SavedMap) -> SavedMap:
    """The map itself; MapError where it has none, of who localizes by reflectors alone."""
    if not len(saved.reflectors):
        raise MapError('the map has no reflectors, and the EKF localizes by reflectors alone')
    return saved


def load(path: str | Path) -> SavedMap:
    """The map of text files: of a folder, or of NAME.yaml and NAME.csv, one of which is named.

    A folder is that of a replay (reflectors.csv, map.yaml) or of a map saved as ``map``. Where one
    of the two files is missing, so is that part of the map. Raises MapError if none is there,
    FileFormatError if one is malformed.
    """
    path = Path(path)
    if path.is_dir():
        tables, meta = [path / 'reflectors.csv', path / 'map.csv'], path / 'map.yaml'
    elif path.exists():
        tables, meta = [path.with_suffix('.csv')], path.with_suffix('.yaml')
    else:
        raise NoMapError(f'{path}: there is no such map')
    table = next((t for t in tables if t.exists()), None)
    if table is None and not meta.exists():
        raise NoMapError(f'{path}: neither reflectors.csv nor map.csv nor map.yaml is there')
    return SavedMap(
        no_reflectors() if table is None else reflector_file.load(table),
        nav2_map.load(meta) if meta.exists() else None,
    )


def no_reflectors() -> Reflectors:
    """A reflector map with nothing in it."""
    none = np.zeros(0, dtype=np.int64)
    return Reflectors(none, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none, np.zeros(0))


def newer_image(whole: Path) -> str:
    """What to say where the image of a map was changed after its .rlml file; else empty."""
    meta = whole.with_suffix('.yaml')
    try:
        image = nav2_map.describe(meta).image
        if image.stat().st_mtime_ns <= whole.stat().st_mtime_ns:
            return ''
    except (RlmlError, OSError):
        return ''
    return (
        f'{image} is newer than {whole.name}, which is used: what was edited in the image is not. '
        f'To localize in the image, name {meta.name}'
    )
