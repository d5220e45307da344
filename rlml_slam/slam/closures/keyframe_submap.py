# SPDX-License-Identifier: Apache-2.0
"""Submap of the back end: built from keyframe scans, attached to an anchor keyframe."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.graph import relative_information
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.submaps import GRID_TURN
from rlml_slam.slam.keyframes import Keyframe

TURN = np.array([0.0, 0.0, GRID_TURN])
# [1/m², 1/rad²] added to the information of a match: a direction that the scan does not constrain
# has a standard deviation of 10 m or 10 rad
WEAK_INFORMATION = 1e-2


@dataclass(eq=False)
class KeyframeSubmap:
    """Submap of ``size`` keyframes, at ``T_anchor_grid`` (3,) from keyframe ``anchor``.

    While it is built, the anchor is its first keyframe and the grid is turned by GRID_TURN.
    ``last_search`` is the stamp of the last keyframe that was searched in it.
    """

    anchor: Keyframe
    submap: Submap
    size: int = 0
    centre: Array = field(default_factory=lambda: np.zeros(2))
    T_anchor_grid: Array = field(default_factory=lambda: TURN)
    last_search: int = 0

    @cached_property
    def walls(self) -> Array:
        """Occupied cells (n, 2) of the finished submap."""
        return self.submap.walls()

    @cached_property
    def reach(self) -> float:
        """Distance [m] of the farthest wall from the centre."""
        return float(np.hypot(*(self.walls - self.centre).T).max(initial=0.0))

    @cached_property
    def wall_tree(self) -> cKDTree:
        """The walls, for a search of the nearest one."""
        return cKDTree(self.walls)

    def grid_pose(self, poses: Array) -> Array:
        """Pose (3,) of the grid in the map, with the graph's ``poses`` (n, 3)."""
        return se2.compose(poses[self.anchor.index], self.T_anchor_grid)


def edge_of_match(
    T_anchor_grid: Array, T_grid_key: Array, information: Array, variance_floor: Array
) -> tuple[Array, Array]:
    """Relative poses (..., 3) from anchor to keyframe, and informations of their residuals.

    Of matches at ``T_grid_key`` with ``information`` (..., 3, 3) in the axes of the grid;
    ``variance_floor`` (3,) is added to the covariance.
    """
    cov = np.linalg.inv(information + WEAK_INFORMATION * np.eye(3))
    R = np.zeros_like(cov)
    R[..., :2, :2], R[..., 2, 2] = se2.rotation(T_anchor_grid[..., 2]), 1.0
    cov = R @ cov @ np.swapaxes(R, -1, -2)
    cov[..., [0, 1, 2], [0, 1, 2]] += variance_floor
    delta = se2.compose(T_anchor_grid, T_grid_key)
    return delta, relative_information(delta, cov)
