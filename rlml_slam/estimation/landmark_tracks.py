# SPDX-License-Identifier: Apache-2.0
"""Identity, number of detections and age of each reflector of the front end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS

MEMORY = 50  # double detections over which the spread of a group is averaged
COLUMNS = (
    'keys', 'ids', 'sightings', 'last_seen', 'surveyed', 'diameters', 'spread2', 'doubles',
)  # fmt: skip
MAX_CANDIDATES = 40  # the oldest beyond this are dropped: ghosts must not fill the state


def _ints() -> NDArray[np.int64]:
    return np.zeros(0, dtype=np.int64)


@dataclass
class LandmarkTracks:
    """Columns (m,) parallel to the reflectors of the joint state.

    ``keys`` never repeat; ``ids`` of the reflectors or ANONYMOUS; ``sightings``: number of
    detections; ``last_seen``: stamp [ns]; ``surveyed``: from a map, never dropped. ``spread2``
    [m²]: variance per axis of a detection in a group of reflectors that are not distinguished,
    the mean of ``doubles`` double detections; zero without any.
    """

    keys: NDArray[np.int64] = field(default_factory=_ints)
    ids: NDArray[np.int64] = field(default_factory=_ints)
    sightings: NDArray[np.int64] = field(default_factory=_ints)
    last_seen: NDArray[np.int64] = field(default_factory=_ints)
    surveyed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    diameters: Array = field(default_factory=lambda: np.zeros(0))
    spread2: Array = field(default_factory=lambda: np.zeros(0))
    doubles: NDArray[np.int64] = field(default_factory=_ints)
    next_key: int = 0

    def __len__(self) -> int:
        return len(self.keys)

    def append(self, stamp: int, id_: int, diameter: float, surveyed: bool = False) -> int:
        """Add a reflector with one detection; returns its key."""
        key = self.next_key
        self.next_key += 1
        self.keys = np.append(self.keys, key)
        self.ids = np.append(self.ids, id_)
        self.sightings = np.append(self.sightings, 0 if surveyed else 1)
        self.last_seen = np.append(self.last_seen, stamp)
        self.surveyed = np.append(self.surveyed, surveyed)
        self.diameters = np.append(self.diameters, diameter)
        self.spread2 = np.append(self.spread2, 0.0)
        self.doubles = np.append(self.doubles, 0)
        return key

    def survey(self, keys: NDArray[np.int64], ids: NDArray[np.int64], diameters: Array) -> None:
        """Add reflectors (k,) of a saved map, with the keys of the map."""
        k = len(keys)
        self.keys = np.append(self.keys, keys)
        self.ids = np.append(self.ids, ids)
        self.sightings = np.append(self.sightings, np.zeros(k, dtype=np.int64))
        self.last_seen = np.append(self.last_seen, np.zeros(k, dtype=np.int64))
        self.surveyed = np.append(self.surveyed, np.ones(k, dtype=np.bool_))
        self.diameters = np.append(self.diameters, diameters)
        self.spread2 = np.append(self.spread2, np.zeros(k))
        self.doubles = np.append(self.doubles, np.zeros(k, dtype=np.int64))

    def see(self, index: NDArray[np.int64], stamp: int, ids: NDArray[np.int64]) -> None:
        """Count detections of the reflectors at ``index``; a detected id is kept."""
        self.sightings[index] += 1
        self.last_seen[index] = stamp
        known = ids != ANONYMOUS
        self.ids[index[known]] = ids[known]

    def see_double(self, index: int, distance: float) -> None:
        """Two detections at a ``distance`` [m] are both of the reflector at ``index``."""
        self.doubles[index] += 1
        gain = 1.0 / min(int(self.doubles[index]), MEMORY)
        self.spread2[index] += gain * (0.25 * distance**2 - self.spread2[index])

    def confirmed(self, min_sightings: int) -> NDArray[np.bool_]:
        """(m,): detected often enough, or from a map."""
        return (self.sightings >= min_sightings) | self.surveyed

    def stale(self, now: int, min_sightings: int, timeout: float) -> NDArray[np.bool_]:
        """(m,): candidates to drop: too old, or the oldest beyond MAX_CANDIDATES."""
        if not len(self.keys):
            return np.zeros(0, dtype=np.bool_)
        candidate = ~self.confirmed(min_sightings)
        drop = candidate & (now - self.last_seen > timeout * 1e9)
        left = np.flatnonzero(candidate & ~drop)
        if len(left) > MAX_CANDIDATES:
            order = np.lexsort((self.keys[left], self.last_seen[left]))
            drop[left[order[: len(left) - MAX_CANDIDATES]]] = True
        return drop

    def rename(self, aliases: dict[int, int]) -> None:
        """Replace the keys of merged reflectors; all of one key get the newest stamp."""
        self.keys = np.array([aliases.get(k, k) for k in self.keys.tolist()], dtype=np.int64)
        for key in set(aliases.values()):
            same = self.keys == key
            if same.any():
                self.last_seen[same] = self.last_seen[same].max()

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Drop reflectors where the mask (m,) is false."""
        for name in COLUMNS:
            setattr(self, name, getattr(self, name)[mask])

    def take(self, mask: NDArray[np.bool_]) -> LandmarkTracks:
        """Remove and return the reflectors where the mask (m,) is true."""
        taken = replace(self)
        taken.keep(mask)
        self.keep(~mask)
        return taken

    def extend(self, others: LandmarkTracks) -> None:
        """Append reflectors that :meth:`take` removed."""
        for name in COLUMNS:
            setattr(self, name, np.concatenate([getattr(self, name), getattr(others, name)]))
