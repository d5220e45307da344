# SPDX-License-Identifier: Apache-2.0
"""Records of reflectors that were removed from the map: position and detection history."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph import Column
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.landmark import Landmark

# Records kept; the oldest are dropped first, and candidates before mapped reflectors: thousands of
# ghosts appear in a day, and moved reflectors are recognized by their previous position.
MAX_RECORDS = 1000
# ``mapped``: it was in the map, not only a candidate
REMOVED = np.dtype(
    [
        ('key', np.int64), ('id', np.int64), ('place', np.float64, (2,)), ('count', np.int64),
        ('first', np.int64), ('last', np.int64), ('mapped', np.bool_),
    ]
)  # fmt: skip


class RemovedLandmarks:
    """Rows of REMOVED, the oldest first."""

    def __init__(self) -> None:
        self._rows = Column((), REMOVED)

    @property
    def rows(self) -> NDArray[np.void]:
        """All records (n,)."""
        return self._rows.view

    @property
    def keys(self) -> list[int]:
        """Keys (n,)."""
        return [int(key) for key in self.rows['key']]

    def add(self, m: Landmark, place: Array) -> None:
        """Add a reflector that was at ``place`` (2,) of the map."""
        row = np.zeros(1, dtype=REMOVED)
        row['key'], row['id'], row['place'], row['count'] = m.key, m.id, place, m.count
        row['first'], row['last'], row['mapped'] = m.history.first, m.history.last, m.index >= 0
        self._rows.append(row)
        if len(self._rows) > 2 * MAX_RECORDS:
            rows = self._rows.view
            newest = np.argsort(rows['mapped'], kind='stable')[-MAX_RECORDS:]
            kept = rows[np.sort(newest)].copy()
            self._rows = Column((), REMOVED)
            self._rows.append(kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """To be saved."""
        return {'reflector_removed': self.rows}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the records of a saved map; an imported one has none."""
        self._rows = Column((), REMOVED)
        self._rows.append(arrays.get('reflector_removed', np.zeros(0, dtype=REMOVED)))
