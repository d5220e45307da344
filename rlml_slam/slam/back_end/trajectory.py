# SPDX-License-Identifier: Apache-2.0
"""The optimised path: every frame hangs on a keyframe, and goes where that goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.model.factor_table import Column
from rlml_slam.se2 import Array

Arrays = Mapping[str, NDArray[Any]]

# A frame: its keyframe, its pose there, and its share of the correction up to the next keyframe.
ROW = np.dtype(
    [('stamp', np.int64), ('key', np.int32), ('share', np.float32), ('pose', np.float64, (3,))]
)


# A keyframe that there ever was, by its number: while it is in the map ``onto`` is -1, later the
# number of the one that what hung on it hangs on, with it at ``pose`` there. ``first`` and ``end``
# are the rows of its own frames.
HANGER = np.dtype(
    [('onto', np.int64), ('pose', np.float64, (3,)), ('first', np.int64), ('end', np.int64)]
)


class Path:
    """Between two keyframes the front end's path is kept; the rest is spread over it by index.

    Beyond ``limit`` frames, every second one is let go. Frames keep the number of their keyframe
    when keyframes go, which so takes as long as there are of these, however long the path is.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows = Column((), ROW)
        self._restart(np.zeros((0, 3)))

    def _restart(self, motion: Array) -> None:
        """There are as many keyframes as motions (n - 1, 3) between them tell, without frames."""
        self._motion = Column((3,))  # the front end's from each keyframe to the next one
        self._motion.append(motion)
        hangers = np.zeros(len(motion) + 1, dtype=HANGER)
        hangers['onto'] = -1
        self._hangers = Column((), HANGER)
        self._hangers.append(hangers)
        self._numbers = np.arange(len(hangers))  # of the keyframes by index

    def begin_keyframe(self, motion: Array) -> None:
        """Another keyframe follows the newest one, at the front end's ``motion`` (3,)."""
        newest = self._hangers.view[-1]
        newest['end'] = len(self._rows)
        rows = self._rows.view[newest['first'] : newest['end']]
        rows['share'] = np.arange(len(rows)) / max(len(rows), 1)
        self._motion.append(motion[None])
        self._numbers = np.append(self._numbers, len(self._hangers))
        hanger = np.zeros(1, dtype=HANGER)
        hanger['onto'], hanger['first'] = -1, len(self._rows)
        self._hangers.append(hanger)

    def add(self, stamp: int, T_key_base: Array) -> None:
        """A frame, seen from the newest keyframe."""
        if len(self._rows) >= self._limit:
            self._thin()
        row = np.zeros(1, dtype=ROW)
        row['stamp'], row['key'], row['pose'] = stamp, self._numbers[-1], T_key_base
        self._rows.append(row)

    def _thin(self) -> None:
        self._settle()
        kept = np.ones(len(self._rows), dtype=np.bool_)
        kept[1 : self._hangers.view[-1]['first'] : 2] = False
        before = np.concatenate([[0], np.cumsum(kept)])
        for name in ('first', 'end'):
            self._hangers.view[name] = before[self._hangers.view[name]]
        rows = self._rows.view[kept]
        self._rows = Column((), ROW)
        self._rows.append(rows)

    def _settle(self) -> None:
        """Hang each frame on a keyframe of now, and number these by their indices."""
        hangers = self._hangers.view
        onto, pose = hangers['onto'].copy(), hangers['pose'].copy()
        last = np.where(onto < 0, np.arange(len(onto)), onto)
        while (far := onto[last] >= 0).any():  # each time twice as far
            pose[far] = se2.compose(pose[last[far]], pose[far])
            last[far] = last[last[far]]
        rows = self._rows.view
        loose = onto[rows['key']] >= 0
        key = rows['key'][loose]
        rows['pose'][loose] = se2.compose(pose[key], rows['pose'][loose])
        index = np.full(len(onto), -1)
        index[self._numbers] = np.arange(len(self._numbers))
        rows['key'] = index[last[rows['key']]]
        self._hangers.keep(onto < 0)
        self._numbers = np.arange(len(self._numbers))

    def arrays(self) -> Arrays:
        """All that is known, to be saved."""
        self._settle()
        return {'path': self._rows.view, 'path_motion': self._motion.view}

    def restore(self, arrays: Arrays) -> None:
        """Go on after the keyframes that were saved; the frames of then stay with the file."""
        self._rows = Column((), ROW)
        self._restart(arrays['path_motion'])

    def stamps(self) -> NDArray[np.int64]:
        """Stamps (n,)."""
        return np.array(self._rows.view['stamp'])

    def poses(self, keys: Array) -> Array:
        """Poses (n, 3) in the map frame, where the keyframes' are ``keys`` (k, 3)."""
        self._settle()
        return poses_of(self._rows.view, self._motion.view, keys)

    def renumber(self, keys: Array, new: NDArray[np.int64], onto: NDArray[np.int64]) -> None:
        """Keyframe k becomes ``new[k]``, or where that is -1, its frames hang on ``onto[k]``.

        ``keys`` (k, 3) are the poses at this moment: a frame that hangs on another keyframe from
        now on, or whose next keyframe goes, stays where it is beside the one that it hangs on.
        """
        gone, hangers = np.flatnonzero(new < 0), self._hangers.view
        # the newest keyframe has none after it, and no shares
        for k in np.union1d(gone, gone - 1)[int(0 in gone) :].tolist():
            if k + 1 < len(new):
                self._hold(k, keys)
        number = self._numbers[gone]
        hangers['onto'][number] = self._numbers[onto[gone]]
        hangers['pose'][number] = se2.between(keys[onto[gone]], keys[gone])
        self._numbers = self._numbers[new >= 0]
        motion = self._motion.view[new[:-1] >= 0]
        self._motion = Column((3,))
        self._motion.append(motion)

    def _hold(self, k: int, keys: Array) -> None:
        """The own frames of keyframe k stay where they are beside it, whatever the next does."""
        hanger = self._hangers.view[self._numbers[k]]
        rows = self._rows.view[hanger['first'] : hanger['end']]
        rows = rows[rows['share'] > 0.0]
        if not len(rows):
            return
        missing = se2.log(se2.between(se2.compose(keys[k], self._motion.view[k]), keys[k + 1]))
        part = se2.exp(missing * rows['share'].astype(np.float64)[:, None])
        own = slice(int(hanger['end']) - len(rows), int(hanger['end']))
        self._rows.view['pose'][own] = se2.compose(rows['pose'], part)
        self._rows.view['share'][own] = 0.0


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
