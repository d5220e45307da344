# SPDX-License-Identifier: Apache-2.0
"""A map as it is saved and loaded."""

from __future__ import annotations

from dataclasses import dataclass

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.types import Reflectors


@dataclass(frozen=True)
class SavedMap:
    """Reflectors and, where scans were used, the grid."""

    reflectors: Reflectors
    grid: OccupancyGrid | None = None
