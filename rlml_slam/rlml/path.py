# SPDX-License-Identifier: Apache-2.0
"""The optimised path: every frame hangs on a keyframe, and goes where that goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.table import Column
from rlml_slam.se2 import Array

Arrays = Mapping[str, NDArray[Any]]

# A frame: its keyframe, its pose there, and its share of the correction up to the next keyframe.
ROW = np.dtype(
    [('stamp', np.int64), ('key', np.int32), ('share', np.float32), ('pose', np.float64, (3,))]
)


class Path:
    """Between two keyframes the front end's path is kept; the rest is spread over it by index.

    Beyond ``limit`` frames, every second one is let go.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows = Column((), ROW)
        self._begin = 0  # first frame of the newest keyframe
        self._motion = Column((3,))  # the front end's from each keyframe to the next one

    def begin_keyframe(self, motion: Array) -> None:
        """Another keyframe follows the newest one, at the front end's ``motion`` (3,)."""
        rows = self._rows.view[self._begin :]
        rows['share'] = np.arange(len(rows)) / max(len(rows), 1)
        self._motion.append(motion[None])
        self._begin = len(self._rows)

    def add(self, stamp: int, T_key_base: Array) -> None:
        """A frame, seen from the newest keyframe."""
        if len(self._rows) >= self._limit:
            self._thin()
        row = np.zeros(1, dtype=ROW)
        row['stamp'], row['key'], row['pose'] = stamp, len(self._motion), T_key_base
        self._rows.append(row)

    def _thin(self) -> None:
        rows = self._rows.view
        kept = np.ones(len(rows), dtype=np.bool_)
        kept[1 : self._begin : 2] = False
        self._begin = int(kept[: self._begin].sum())
        self._rows = Column((), ROW)
        self._rows.append(rows[kept])

    def arrays(self) -> Arrays:
        """All that is known, to be saved."""
        return {'path': self._rows.view, 'path_motion': self._motion.view}

    def restore(self, arrays: Arrays) -> None:
        """Go on after the keyframes that were saved; the frames of then stay with the file."""
        self._rows, self._motion = Column((), ROW), Column((3,))
        self._motion.append(arrays['path_motion'])
        self._begin = 0

    def stamps(self) -> NDArray[np.int64]:
        """Stamps (n,)."""
        return np.array(self._rows.view['stamp'])

    def poses(self, keys: Array) -> Array:
        """Poses (n, 3) in the map frame, where the keyframes' are ``keys`` (k, 3)."""
        return poses_of(self._rows.view, self._motion.view, keys)

    def renumber(self, keys: Array, new: NDArray[np.int64], onto: NDArray[np.int64]) -> None:
        """Keyframe k becomes ``new[k]``, or where that is -1, its frames hang on ``onto[k]``.

        ``keys`` (k, 3) are the poses at this moment: a frame that hangs on another keyframe from
        now on, or whose next keyframe goes, stays where it is beside the one that it hangs on.
        """
        rows, gone = self._rows.view, new < 0
        key = rows['key']
        # the newest keyframe has none after it, and no shares
        loose = gone[key] | ((rows['share'] > 0.0) & gone[np.minimum(key + 1, len(new) - 1)])
        moved = rows[loose]
        target = np.where(gone[moved['key']], onto[moved['key']], moved['key'])
        moved['pose'] = se2.between(keys[target], poses_of(moved, self._motion.view, keys))
        moved['key'], moved['share'] = target, 0.0
        rows[loose] = moved
        rows['key'] = new[rows['key']]
        motion = self._motion.view[~gone[:-1]]
        self._motion = Column((3,))
        self._motion.append(motion)


def poses_of(rows: NDArray[np.void], motion: Array, keys: Array) -> Array:
    """Poses (n, 3) of frames in the map frame; ``motion`` (k, 3) is that between keyframes."""
    key, share = rows['key'], rows['share'].astype(np.float64)
    out = se2.compose(keys[key], rows['pose'])
    spread = np.flatnonzero(share)
    if len(spread):
        first, at = np.unique(key[spread], return_inverse=True)  # once per keyframe
        missing = se2.log(se2.between(se2.compose(keys[first], motion[first]), keys[first + 1]))
        part = missing[at] * share[spread, None]
        out[spread] = se2.compose(out[spread], se2.exp(part))
    return out
