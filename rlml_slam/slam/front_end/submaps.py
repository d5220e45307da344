# SPDX-License-Identifier: Apache-2.0
"""Two overlapping submaps: scans are matched against the older one and inserted into both."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from rlml_slam import params, se2
from rlml_slam.estimation.common_error import CommonError
from rlml_slam.matching.scans import voxel_filter
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.joint_state import JointState

# [rad] Walls are mostly parallel or normal to the route of a robot. A grid that is rotated against
# them has a rounding error that averages out along a wall; that of a parallel grid would shift the
# whole wall by up to half a cell.
GRID_TURN = 0.53
# [m] from a submap's anchor: no scan of it is as far away unless the pose was wrong
FAR = 500.0

Placed: TypeAlias = tuple[Array, Array]  # end points and sensor origin in the submap's frame


class Submaps:
    """The front end's submaps; the anchor of submap k is slot k of the joint state."""

    def __init__(self, parameters: params.Submap) -> None:
        self._p = parameters
        self._maps: list[Submap] = []
        self._pending: list[list[Placed]] = []  # of each submap, scans that are not carved yet
        self._last: Array | None = None
        self.bias = np.zeros((3, 3))
        self.bias[[0, 1, 2], [0, 1, 2]] = parameters.bias_variance

    @property
    def target(self) -> Submap | None:
        """The submap that scans are matched against, None before the first scan."""
        if not self._maps:
            return None
        self._carve(0)
        return self._maps[0]

    def insert(
        self, state: JointState, points: Array, origin: Array, common: CommonError | None = None
    ) -> bool:
        """Insert end points and sensor origin (base frame) if the robot has moved enough.

        Meanwhile the heading drifts, by an error that pose and submaps have in ``common``
        (eq. 71); None where reflectors or a saved map measure it.

        The grids change at the next :meth:`settle`, or before they are read.
        """
        pose = state.pose
        if self._last is not None:
            step = se2.between(self._last, pose)
            way = math.hypot(step[0], step[1])
            if way < self._p.min_travel and abs(step[2]) < self._p.min_turn:
                return False
            if common is not None:
                common.add(pose, np.diag([0.0, 0.0, self._p.heading_drift**2 * way]))
        self._last = pose
        self._turn_over(state)
        points = voxel_filter.thin(points, self._p.resolution, self._p.max_points)
        for slot, scans in enumerate(self._pending):
            T = se2.between(state.anchor(slot), pose)
            placed = se2.transform(T, points), se2.transform(T, origin[None])[0]
            if not all((np.abs(part) < FAR).all() for part in placed):
                self.start_again()  # the pose or the anchor is wrong, and no grid spans that
                return False
            scans.append(placed)
        return True

    def start_again(self) -> None:
        """Drop all submaps; the next scan starts a new one."""
        self._maps, self._pending, self._last = [], [], None

    def settle(self) -> None:
        """Carve the scan that was inserted last: it takes longest, and no pose needs it at once.

        The newer submap is not read yet and may be one scan behind, so that the two are carved
        in different frames if not every frame is inserted.
        """
        due = bool(self._pending and self._pending[0])
        for slot in range(len(self._pending)):
            self._carve(slot, keep=int(due and slot > 0))

    def _carve(self, slot: int, keep: int = 0) -> None:
        """Carve all pending scans of a submap except the newest ``keep``."""
        scans = self._pending[slot]
        while len(scans) > keep:
            self._maps[slot].insert(*scans.pop(0))

    def _turn_over(self, state: JointState) -> None:
        """Retire a full submap; start the next one when it is half full."""
        if len(self._maps) > 1 and self._inserted(0) >= self._p.insertions:
            del self._maps[0], self._pending[0]
            state.move_anchor(1, 0)
        if not self._maps or (
            len(self._maps) == 1 and self._inserted(0) >= self._p.insertions // 2
        ):
            state.clone_pose(len(self._maps), GRID_TURN, self.bias)
            self._maps.append(Submap(self._p))
            self._pending.append([])

    def _inserted(self, slot: int) -> int:
        """Number of scans of a submap, carved or pending."""
        return self._maps[slot].insertions + len(self._pending[slot])

    def cells(self) -> int:
        """Allocated grid cells, for the memory report."""
        return int(np.sum([m.values.size for m in self._maps]))
