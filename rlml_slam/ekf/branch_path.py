# SPDX-License-Identifier: Apache-2.0
"""Path of a branch: poses and steps of the filter, shared with the branches it came from."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from rlml_slam.estimation.smoother import Sight, Step
from rlml_slam.motion import STILL
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class PathNode:
    """Pose (3,) at a stamp, and the node before it."""

    stamp: int
    pose: Array
    before: PathNode | None
    step: Step | None = None


class BranchPath:
    """The newest ``node``; landmarks that were merged have new keys in ``renamed``."""

    def __init__(self) -> None:
        self.node: PathNode | None = None
        self.renamed: dict[int, int] = {}
        self.step = Step(STILL, 0.0, 1.0)

    def copy(self) -> BranchPath:
        """Path of a branch that splits off."""
        out = BranchPath()
        out.node, out.renamed, out.step = self.node, self.renamed.copy(), self.step
        return out

    def append(self, stamp: int, pose: Array, keep_step: bool) -> None:
        """Append a pose, with its step if the path will be smoothed."""
        self.node = PathNode(stamp, pose, self.node, self.step if keep_step else None)

    def add_sight(self, sight: Sight) -> None:
        """Add a measurement to the current step."""
        self.step = dataclasses.replace(self.step, sights=(*self.step.sights, sight))

    def nodes(self) -> list[PathNode]:
        """All nodes, the first one first."""
        out, node = [], self.node
        while node is not None:
            out.append(node)
            node = node.before
        out.reverse()
        return out

    def steps(self) -> list[Step]:
        """Steps up to the first node without one, oldest first, with current landmark keys."""
        out, node = [], self.node
        while node is not None and node.step is not None:
            sights = (dataclasses.replace(s, key=self._current(s.key)) for s in node.step.sights)
            out.append(dataclasses.replace(node.step, sights=tuple(sights)))
            node = node.before
        out.reverse()
        return out

    def _current(self, key: int) -> int:
        while key in self.renamed:
            key = self.renamed[key]
        return key
