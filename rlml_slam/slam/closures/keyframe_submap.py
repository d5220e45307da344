# SPDX-License-Identifier: Apache-2.0
"""A submap of the back end: made of keyframes, and hung on one of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rlml_slam.matching.scans.submap import Submap
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.submaps import GRID_TURN
from rlml_slam.slam.keyframes import Keyframe

TURN = np.array([0.0, 0.0, GRID_TURN])


@dataclass(eq=False)
class KeyframeSubmap:
    """A submap of ``size`` keyframes, at ``T_anchor_grid`` (3,) from keyframe ``anchor``.

    While it is being built that is the first of them, and the submap is turned by GRID_TURN.
    ``turn`` is the stamp of the last keyframe that was looked for in it.
    """

    anchor: Keyframe
    submap: Submap
    size: int = 0
    centre: Array = field(default_factory=lambda: np.zeros(2))
    T_anchor_grid: Array = field(default_factory=lambda: TURN)
    turn: int = 0

    @cached_property
    def walls(self) -> Array:
        """Those of the submap (n, 2), which is to be complete."""
        return self.submap.walls()
