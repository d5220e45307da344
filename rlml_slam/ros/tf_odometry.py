# SPDX-License-Identifier: Apache-2.0
"""Odometry out of /tf: the transform from odom to base, through whatever frames lie between."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.decode import Transform
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.types import Odometry

TF = '/tf'
SAME = 1e-12  # [m] and of a rotation matrix: a transform that was only repeated


class TfOdometry:
    """Follows the transforms on /tf; ``tree`` gets the transforms, the sensors' places as well.

    Several transforms may lie between odom and base. A sample comes with the one of them that
    moves, with its stamp; the others are taken as they are then.
    """

    def __init__(self, tree: Extrinsics, odom_frame: str, base_frame: str, map_frame: str) -> None:
        self.tree = tree
        self._ends = odom_frame, base_frame
        self._map = map_frame
        self._path: tuple[str, ...] = ()
        self._version = -1  # of the tree, whose path that is
        self._seen: set[str] = set()  # children that came on /tf
        self._moved: set[str] = set()  # of those, the ones that were not only repeated

    @property
    def path(self) -> tuple[str, ...]:
        """The children of the transforms between odom and base, empty if there is no way."""
        if self._version != self.tree.version:
            self._version = self.tree.version
            path = self.tree.path(*self._ends) or ()
            # what passes the map is somebody's localization, not odometry
            self._path = () if any(self._passes_map(child) for child in path) else path
        return self._path

    def add(self, msg: Any) -> list[Odometry]:
        """One TransformStamped of /tf; the pose (3,) of base in odom, if it gives one."""
        child, parent = decode.frame(msg.child_frame_id), decode.frame(msg.header.frame_id)
        is_known = child in self._seen and self.tree.parent(child) == parent
        if is_known and child not in self.path:
            return []  # a sensor's place is that of the beginning
        self._take(*decode.transforms(msg, TF))
        return [self._sample(decode.stamp(msg, TF))] if child == self._trigger() else []

    def _take(self, t: Transform) -> None:
        before = self.tree.step(t.child)
        if before is not None and before.parent == t.parent and t.child in self._seen:
            moved = max(np.abs(before.R - t.R).max(), np.abs(before.t - t.t).max())
            if moved > SAME:
                self._moved.add(t.child)
        self._seen.add(t.child)
        self.tree.move(t)

    def _passes_map(self, child: str) -> bool:
        return self._map in (child, self.tree.parent(child)) and self._map not in self._ends

    def _trigger(self) -> str | None:
        """The transform with which the pose changes."""
        on_tf = [child for child in self.path if child in self._seen]
        moving = [child for child in on_tf if child in self._moved]
        return next(iter(moving or on_tf), None)

    def _sample(self, stamp: int) -> Odometry:
        found = self.tree.between(*self._ends)
        assert found is not None  # there is a path
        R, t = found
        where = f'{TF}: {self._ends[0]} to {self._ends[1]}'
        return Odometry(stamp, np.array([t[0], t[1], decode.yaw(R, where)]))
