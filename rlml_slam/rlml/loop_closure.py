# SPDX-License-Identifier: Apache-2.0
"""Scans in the graph: keyframes tied to submaps as they are built, and to finished ones later.

A closure is searched by branch and bound over the whole window, refined, and verified by its score
and by the lead over the second-best place; what fails is recorded, not used.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np

from rlml_slam import se2
from rlml_slam.graph.factors import relative_information
from rlml_slam.graph.graph import Graph
from rlml_slam.matching import observability, search, thinning
from rlml_slam.matching.scan_match import match
from rlml_slam.matching.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.rlml.keyframes import Keyframe
from rlml_slam.rlml.submaps import GRID_TURN
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

TURN = np.array([0.0, 0.0, GRID_TURN])
TURN_ROTATION = np.eye(3)
TURN_ROTATION[:2, :2] = se2.rotation(GRID_TURN)
OPEN = 1e-2  # [1/m², 1/rad²] an edge knows its directions to 10 m and 10 rad at the worst
PYRAMIDS = 16  # search pyramids kept: each is several times as large as its submap


@dataclass(frozen=True)
class Closure:
    """A loop closure that was tried: poses ``i`` (submap's anchor) and ``j``, and the verdict.

    ``edge`` is its index in ``graph.edges``, -1 where it was rejected; ``why`` says it in words.
    """

    i: int
    j: int
    delta: Array
    score: float
    edge: int
    why: str

    @property
    def accepted(self) -> bool:
        """Whether it entered the graph."""
        return self.edge >= 0


@dataclass
class _KeyMap:
    """A submap of keyframes; its frame is that of keyframe ``anchor``, turned by GRID_TURN."""

    anchor: Keyframe
    submap: Submap
    members: set[int] = field(default_factory=set)
    centre: Array = field(default_factory=lambda: np.zeros(2))


class ScanGraph:
    """Scan edges and loop closures of the back end."""

    def __init__(self, params: Parameters, graph: Graph) -> None:
        self._p = params
        self._graph = graph
        self._active: list[_KeyMap] = []
        self._finished: list[_KeyMap] = []
        self._pyramids: OrderedDict[int, search.Pyramid] = OrderedDict()
        self._count = 0
        self.closures: list[Closure] = []
        self.changed = False

    def add(self, key: Keyframe) -> tuple[Closure, ...]:
        """Tie a keyframe to the submaps being built, insert it, look for closures."""
        assert key.points is not None
        assert key.origin is not None
        if len(key.points) < self._p.scan_match.min_points:
            return ()
        points = thinning.thin(key.points, self._p.scan_match.voxel, self._p.scan_match.max_points)
        p = self._p.submap
        for m in self._active:
            self._tie(m, key, points)
        self._insert(key, thinning.thin(key.points, p.resolution, p.max_points))
        self._count += 1
        if not self._p.loop_closure.enabled or self._count % self._p.loop_closure.every:
            return ()
        return self._close(key, points)

    def begin_piece(self) -> None:
        """Complete the submaps that are being built: the robot goes on from elsewhere."""
        self._finished += self._active
        self._active = []

    def finish(self) -> None:
        """Nothing is held back for the end."""

    def _tie(self, m: _KeyMap, key: Keyframe, points: Array) -> None:
        """A scan edge from the submap's anchor, where the scan fits."""
        if not m.members:
            return
        guess = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
        prior = np.diag(1.0 / np.array(self._p.back_end.match_sigma) ** 2)
        p = self._p.scan_match
        found = match(m.submap, points, guess, prior, p, searched=False)
        if found.score < p.min_score or key.index == m.anchor.index:
            return
        information = observability.information(m.submap, points, found.pose, p)
        self._edge(EdgeKind.SCAN, m.anchor.index, key.index, found.pose, information)

    def _edge(self, kind: EdgeKind, i: int, j: int, delta: Array, information: Array) -> int:
        closure = kind is EdgeKind.CLOSURE
        # a direction that the scan leaves open still needs a covariance, and a regular one
        cov = np.linalg.inv(information + OPEN * np.eye(3))
        cov = TURN_ROTATION @ cov @ TURN_ROTATION.T
        delta = se2.compose(TURN, delta)
        floor2 = self._p.loop_closure.floor2 if closure else self._p.back_end.scan_floor2
        cov[[0, 1, 2], [0, 1, 2]] += floor2
        self.changed |= closure
        return self._graph.add_edge(kind, i, j, delta, relative_information(delta, cov))

    def _insert(self, key: Keyframe, points: Array) -> None:
        size = self._p.back_end.submap_size
        if self._active and len(self._active[0].members) >= size and len(self._active) > 1:
            done = self._active.pop(0)
            self._finished.append(done)
        if not self._active or (
            len(self._active) == 1 and len(self._active[0].members) >= size // 2
        ):
            self._active.append(_KeyMap(key, Submap(self._p.submap)))
        for m in self._active:
            # inside one submap the front end's path is smoother than the graph's
            T = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
            assert key.origin is not None
            m.submap.insert(se2.transform(T, points), se2.transform(T, key.origin[None])[0])
            m.members.add(key.index)
            m.centre = m.centre + (T[:2] - m.centre) / len(m.members)

    def _pose(self, key: Keyframe) -> Array:
        pose: Array = self._graph.poses[key.index]
        return pose

    def _grid(self, m: _KeyMap) -> Array:
        return se2.compose(self._pose(m.anchor), TURN)

    def _close(self, key: Keyframe, points: Array) -> tuple[Closure, ...]:
        """Try the finished submaps near the keyframe, the nearest first."""
        p = self._p.loop_closure
        here = self._pose(key)[:2]
        near = []
        for k, m in enumerate(self._finished):
            centre = se2.transform(self._grid(m), m.centre[None])[0]
            distance = float(np.linalg.norm(centre - here))
            if distance < p.max_distance:
                near.append((distance, k))
        out = []
        for _, k in sorted(near)[: p.candidates]:
            closure = self._try(k, key, points)
            self.closures.append(closure)
            out.append(closure)
        return tuple(out)

    def _try(self, k: int, key: Keyframe, points: Array) -> Closure:
        p, m = self._p.loop_closure, self._finished[k]
        guess = se2.between(self._grid(m), self._pose(key))
        i, j = m.anchor.index, key.index

        def rejected(why: str, score: float = 0.0) -> Closure:
            return Closure(i, j, guess, score, -1, why)

        result = search.wide(
            self._pyramid(k), points, guess, p.search_window, p.search_angle, p.min_score,
            second_share=p.max_second,
        )  # fmt: skip
        if result.best is None:
            return rejected('no place in the window fits')
        if result.second is not None and result.second.score > p.max_second * result.best.score:
            return rejected('a second place fits as well', result.best.score)
        weak = np.diag(1.0 / np.array([0.5, 0.5, 0.2]) ** 2)
        found = match(m.submap, points, result.best.pose, weak, self._p.scan_match, searched=False)
        if found.score < p.min_score:
            return rejected('the refined fit is too weak', found.score)
        information = observability.information(m.submap, points, found.pose, self._p.scan_match)
        edge = self._edge(EdgeKind.CLOSURE, i, j, found.pose, information)
        return Closure(i, j, found.pose, found.score, edge, 'fits')

    def _pyramid(self, k: int) -> search.Pyramid:
        if k not in self._pyramids:
            self._pyramids[k] = search.Pyramid(self._finished[k].submap)
            if len(self._pyramids) > PYRAMIDS:
                self._pyramids.popitem(last=False)
        self._pyramids.move_to_end(k)
        return self._pyramids[k]
