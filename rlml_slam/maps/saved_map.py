# SPDX-License-Identifier: Apache-2.0
"""A map as it is saved and loaded: reflectors and a grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rlml_slam.errors import MapError
from rlml_slam.maps import occupancy, reflector_file
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.types import Reflectors


@dataclass(frozen=True)
class SavedMap:
    """Reflectors and, where scans were used, the grid."""

    reflectors: Reflectors
    grid: OccupancyGrid | None = None


def require_contents(saved: SavedMap) -> SavedMap:
    """The map itself; MapError where there is nothing in it to localize in."""
    if saved.grid is None and len(saved.reflectors) == 0:
        raise MapError('there is no map yet: drive through the place first')
    return saved


def load(folder: str | Path) -> SavedMap:
    """The map of a folder: that which a replay wrote, or the one that was saved as ``map``.

    Raises MapError if there is none, FileFormatError if one of its files is malformed.
    """
    folder = Path(folder)
    tables = [folder / name for name in ('reflectors.csv', 'map.csv')]
    table = next((t for t in tables if t.exists()), None)
    if table is None:
        raise MapError(f'{folder}: neither reflectors.csv nor map.csv is there')
    meta = folder / 'map.yaml'
    return SavedMap(reflector_file.load(table), occupancy.load(meta) if meta.exists() else None)
