# SPDX-License-Identifier: Apache-2.0
"""Reflectors that are no longer in the map: where each was, and what was known of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.model.factor_table import Column
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.landmark import Landmark

# That are remembered; the first ones make room, those that never were in the map before others:
# in a day ghosts come and go by thousands, and what was moved is told by where it was.
MOST = 1000
# ``mapped``: it was in the map, and was not only seen too seldom to enter it
GONE = np.dtype(
    [
        ('key', np.int64), ('id', np.int64), ('place', np.float64, (2,)), ('count', np.int64),
        ('first', np.int64), ('last', np.int64), ('mapped', np.bool_),
    ]
)  # fmt: skip


class RemovedLandmarks:
    """Rows of GONE, the oldest first."""

    def __init__(self) -> None:
        self._rows = Column((), GONE)

    @property
    def rows(self) -> NDArray[np.void]:
        """All of them (n,)."""
        return self._rows.view

    @property
    def keys(self) -> list[int]:
        """Their keys (n,)."""
        return [int(key) for key in self.rows['key']]

    def add(self, m: Landmark, place: Array) -> None:
        """One more, which was at ``place`` (2,) of the map."""
        row = np.zeros(1, dtype=GONE)
        row['key'], row['id'], row['place'], row['count'] = m.key, m.id, place, m.count
        row['first'], row['last'], row['mapped'] = m.life.first, m.life.last, m.index >= 0
        self._rows.append(row)
        if len(self._rows) > 2 * MOST:
            rows = self._rows.view
            newest = np.argsort(rows['mapped'], kind='stable')[-MOST:]
            kept = rows[np.sort(newest)].copy()
            self._rows = Column((), GONE)
            self._rows.append(kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """To be saved."""
        return {'reflector_gone': self.rows}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """What was saved, in a map that is old enough not to know of it nothing."""
        self._rows = Column((), GONE)
        self._rows.append(arrays.get('reflector_gone', np.zeros(0, dtype=GONE)))
