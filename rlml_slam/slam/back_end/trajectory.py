# SPDX-License-Identifier: Apache-2.0
"""Optimized trajectory: the pose of every frame, relative to a keyframe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph import Column
from rlml_slam.se2 import Array

Arrays = Mapping[str, NDArray[Any]]

# A frame: number of its keyframe, pose relative to it, and share of the correction between this
# keyframe and the next one.
ROW = np.dtype(
    [('stamp', np.int64), ('key', np.int32), ('share', np.float32), ('pose', np.float64, (3,))]
)


# Every keyframe by its number, removed ones included: ``onto`` is -1 while it is in the map, later
# the number of the keyframe that took over its frames, with it at ``pose`` relative to that one.
# ``first`` and ``end`` are the rows of its own frames.
REFERENCE = np.dtype(
    [('onto', np.int64), ('pose', np.float64, (3,)), ('first', np.int64), ('end', np.int64)]
)


class FrameTrajectory:
    """Poses of all frames relative to keyframes, corrected with them.

    Between two keyframes the front end's motion is kept, and the correction of their relative
    pose is distributed over the frames by index. Beyond ``limit`` frames every second one is
    removed. Frames keep the number of their keyframe when keyframes are removed, so that the cost
    of a removal does not depend on the length of the trajectory.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows = Column((), ROW)
        self._restart(np.zeros((0, 3)))

    def _restart(self, motion: Array) -> None:
        """Begin with n keyframes without frames, from the motions (n - 1, 3) between them."""
        self._motion = Column((3,))  # of the front end, from each keyframe to the next one
        self._motion.append(motion)
        references = np.zeros(len(motion) + 1, dtype=REFERENCE)
        references['onto'] = -1
        self._references = Column((), REFERENCE)
        self._references.append(references)
        self._numbers = np.arange(len(references))  # of the keyframes by index

    def begin_keyframe(self, motion: Array) -> None:
        """Begin a keyframe at the front end's ``motion`` (3,) from the newest one."""
        newest = self._references.view[-1]
        newest['end'] = len(self._rows)
        rows = self._rows.view[newest['first'] : newest['end']]
        rows['share'] = np.arange(len(rows)) / max(len(rows), 1)
        self._motion.append(motion[None])
        self._numbers = np.append(self._numbers, len(self._references))
        reference = np.zeros(1, dtype=REFERENCE)
        reference['onto'], reference['first'] = -1, len(self._rows)
        self._references.append(reference)

    def add(self, stamp: int, T_key_base: Array) -> None:
        """Add a frame at a pose (3,) relative to the newest keyframe."""
        if len(self._rows) >= self._limit:
            self._thin()
        row = np.zeros(1, dtype=ROW)
        row['stamp'], row['key'], row['pose'] = stamp, self._numbers[-1], T_key_base
        self._rows.append(row)

    def _thin(self) -> None:
        self._resolve()
        kept = np.ones(len(self._rows), dtype=np.bool_)
        kept[1 : self._references.view[-1]['first'] : 2] = False
        before = np.concatenate([[0], np.cumsum(kept)])
        for name in ('first', 'end'):
            self._references.view[name] = before[self._references.view[name]]
        rows = self._rows.view[kept]
        self._rows = Column((), ROW)
        self._rows.append(rows)

    def _resolve(self) -> None:
        """Refer each frame to a keyframe of the map, and number these by their indices."""
        references = self._references.view
        onto, pose = references['onto'].copy(), references['pose'].copy()
        last = np.where(onto < 0, np.arange(len(onto)), onto)
        while (removed := onto[last] >= 0).any():  # pointer doubling
            pose[removed] = se2.compose(pose[last[removed]], pose[removed])
            last[removed] = last[last[removed]]
        rows = self._rows.view
        moved = onto[rows['key']] >= 0
        key = rows['key'][moved]
        rows['pose'][moved] = se2.compose(pose[key], rows['pose'][moved])
        index = np.full(len(onto), -1)
        index[self._numbers] = np.arange(len(self._numbers))
        rows['key'] = index[last[rows['key']]]
        self._references.keep(onto < 0)
        self._numbers = np.arange(len(self._numbers))

    def arrays(self) -> Arrays:
        """Frames and motions, to be saved."""
        self._resolve()
        return {'path': self._rows.view, 'path_motion': self._motion.view}

    def restore(self, arrays: Arrays) -> None:
        """Continue after the saved keyframes; their frames stay in the file."""
        self._rows = Column((), ROW)
        self._restart(arrays['path_motion'])

    def stamps(self) -> NDArray[np.int64]:
        """Stamps (n,)."""
        return np.array(self._rows.view['stamp'])

    def poses(self, keys: Array) -> Array:
        """Poses (n, 3) in the map frame, from those of the keyframes ``keys`` (k, 3)."""
        self._resolve()
        return poses_of(self._rows.view, self._motion.view, keys)

    def renumber(self, keys: Array, new: NDArray[np.int64], onto: NDArray[np.int64]) -> None:
        """Keyframe k becomes ``new[k]``; where that is -1, ``onto[k]`` takes over its frames.

        ``keys`` (k, 3) are the current poses. A frame whose keyframe or next keyframe is removed
        keeps its current pose relative to its keyframe.
        """
        removed, references = np.flatnonzero(new < 0), self._references.view
        # the newest keyframe has no next one, and its frames no shares
        for k in np.union1d(removed, removed - 1)[int(0 in removed) :].tolist():
            if k + 1 < len(new):
                self._freeze(k, keys)
        number = self._numbers[removed]
        references['onto'][number] = self._numbers[onto[removed]]
        references['pose'][number] = se2.between(keys[onto[removed]], keys[removed])
        self._numbers = self._numbers[new >= 0]
        motion = self._motion.view[new[:-1] >= 0]
        self._motion = Column((3,))
        self._motion.append(motion)

    def _freeze(self, k: int, keys: Array) -> None:
        """Apply the current correction to the frames of keyframe k for good."""
        reference = self._references.view[self._numbers[k]]
        rows = self._rows.view[reference['first'] : reference['end']]
        rows = rows[rows['share'] > 0.0]
        if not len(rows):
            return
        correction = se2.log(se2.between(se2.compose(keys[k], self._motion.view[k]), keys[k + 1]))
        part = se2.exp(correction * rows['share'].astype(np.float64)[:, None])
        own = slice(int(reference['end']) - len(rows), int(reference['end']))
        self._rows.view['pose'][own] = se2.compose(rows['pose'], part)
        self._rows.view['share'][own] = 0.0


def poses_of(rows: NDArray[np.void], motion: Array, keys: Array) -> Array:
    """Poses (n, 3) of frames in the map frame; ``motion`` (k, 3) between the keyframes."""
    key, share = rows['key'], rows['share'].astype(np.float64)
    out = se2.compose(keys[key], rows['pose'])
    spread = np.flatnonzero(share)
    if len(spread):
        first, at = np.unique(key[spread], return_inverse=True)  # once per keyframe
        correction = se2.log(se2.between(se2.compose(keys[first], motion[first]), keys[first + 1]))
        part = correction[at] * share[spread, None]
        out[spread] = se2.compose(out[spread], se2.exp(part))
    return out
