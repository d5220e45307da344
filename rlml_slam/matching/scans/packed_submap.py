# SPDX-License-Identifier: Apache-2.0
"""Finished submaps whose cells are compressed until they are used: most cells are unknown."""

from __future__ import annotations

import zlib
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.matching.scans.submap import Submap

LEVEL = 1  # of compression: to about a 17th, at 250 MB/s
KEPT = 64  # submaps whose cells stay unpacked, of 1 to 4 MB each


@dataclass
class Unpacked:
    """The submaps whose cells were unpacked last; of those before, they are let go."""

    submaps: deque[PackedSubmap] = field(default_factory=deque)

    def add(self, submap: PackedSubmap) -> None:
        """A submap was unpacked."""
        self.submaps.append(submap)
        if len(self.submaps) > KEPT:
            del self.submaps.popleft().values


class PackedSubmap(Submap):
    """The same as a finished submap, into which no more scans are inserted."""

    def __init__(self, submap: Submap, unpacked: Unpacked) -> None:
        super().__init__(submap.parameters)
        self.corner, self.insertions = submap.corner, submap.insertions
        self.shape, self._unpacked = submap.values.shape, unpacked
        self._packed = zlib.compress(submap.values.tobytes(), LEVEL)
        del self.values

    def __getattr__(self, name: str) -> Any:
        """Unpack ``values``: Python asks here for what is not there."""
        if name != 'values':
            raise AttributeError(name)
        self.values = self.row_of_cells().reshape(self.shape)
        self._unpacked.add(self)
        return self.values

    def row_of_cells(self) -> NDArray[np.uint16]:
        """All cells (n,) in a row, which are not kept."""
        return np.frombuffer(bytearray(zlib.decompress(self._packed)), dtype=np.uint16)
