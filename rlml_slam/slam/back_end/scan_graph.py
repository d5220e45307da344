# SPDX-License-Identifier: Apache-2.0
"""Scan edges and submaps of the back end: each keyframe matched with the submaps being built."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params, se2
from rlml_slam.graph import Graph
from rlml_slam.maps.pieces import Pieces
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.packed_submap import PackedSubmap
from rlml_slam.matching.scans.scan_match import match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.keyframe_selection import leaves_submap
from rlml_slam.slam.closures.keyframe_submap import TURN, KeyframeSubmap, edge_of_match
from rlml_slam.slam.front_end.submaps import FAR
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind, Frame

COVERED = 0.8  # share of a submap's walls that a newer one must contain to replace it
SAME_PLACE = 0.15  # [m] to the nearest wall of another submap, at which two walls are one
CHANGED = 0.1  # share of walls up to which a submap shows what others show already


class ScanGraph:
    """Submaps of keyframes; ``finished`` ones are searched for loop closures."""

    def __init__(self, parameters: Parameters, graph: Graph) -> None:
        self._p = parameters
        self._graph = graph
        self._active: list[KeyframeSubmap] = []
        self.finished: list[KeyframeSubmap] = []

    def add(self, key: Keyframe) -> Array | None:
        """Match a keyframe with the active submaps and insert it; its thinned points (n, 2).

        None for a scan with too few points.
        """
        points = self.thinned(key)
        if points is None or key.points is None:
            return None
        for m in self._active:
            self._add_scan_edge(m, key, points)
        p = self._p.submap
        whole = key.points.astype(np.float64)
        self._insert(key, voxel_filter.thin(whole, p.resolution, p.max_points))
        return points

    def thinned(self, key: Keyframe) -> Array | None:
        """End points (n, 2) for matching, one per voxel; None where there are too few."""
        p = self._p.scan_match
        if key.points is None or len(key.points) < p.min_points:
            return None
        return voxel_filter.thin(key.points.astype(np.float64), p.voxel_size, p.max_points)

    def follow(self, last: Keyframe, frame: Frame) -> None:
        """Finish the active submaps unless the way from the last keyframe to the next is known."""
        sigma = np.array(self._p.back_end.match_sigma)
        if frame.jumped or leaves_submap(last, frame, sigma):
            self.finish_active()

    def finish_active(self) -> None:
        """Finish the submaps that are being built: the robot continues elsewhere."""
        for m in self._active:
            self._finish(m)
        self._active = []

    @property
    def num_submaps(self) -> int:
        """Number of submaps, active ones included."""
        return len(self.finished) + len(self._active)

    @property
    def oldest_active(self) -> int | None:
        """Index of the first keyframe of the active submaps, None without any."""
        return min((m.anchor.index for m in self._active), default=None)

    def _add_scan_edge(self, m: KeyframeSubmap, key: Keyframe, points: Array) -> None:
        """Edge from the submap's anchor to the keyframe, where the scan matches (eq. 12)."""
        if not m.size:
            return
        guess = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
        prior = np.diag(1.0 / np.array(self._p.back_end.match_sigma) ** 2)
        p = self._p.scan_match
        found = match(m.submap, points, guess, prior, p, searched=False)
        if found.score < p.min_score or key.index == m.anchor.index:
            return
        information = scan_information.information(m.submap, points, found.pose, p)
        floor = self._shared(key) * np.array(self._p.back_end.scan_edge_variance_floor)
        delta, information = edge_of_match(m.T_anchor_grid, found.pose, information, floor)
        self._graph.add_edge(EdgeKind.SCAN, m.anchor.index, key.index, delta, information)

    def _shared(self, key: Keyframe) -> float:
        """Factor of the variance that keyframes of a submap share, for one edge.

        So many keyframes are in the same two submaps: the mean of their edges is to have all
        of it. Where reflectors are seen, these tie the submaps together, and the edges hold the
        keyframes of one submap against each other, where the error that they share cancels.
        """
        seen = self._graph.sightings.nodes[-1:, 0]
        return 1.0 if key.index - 1 in seen else self._p.back_end.submap_size / 2

    def _insert(self, key: Keyframe, points: Array) -> None:
        """Insert a scan into the active submaps; each starts half-way through the one before."""
        size = self._p.back_end.submap_size
        if self._active and self._active[0].size >= size and len(self._active) > 1:
            self._finish(self._active.pop(0))
        if not self._active or (len(self._active) == 1 and self._active[0].size >= size // 2):
            self._active.append(KeyframeSubmap(key, Submap(self._p.submap)))
        for m in tuple(self._active):
            # within one submap the front end's trajectory is smoother than the graph's
            T = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
            assert key.origin is not None
            placed = se2.transform(T, points), se2.transform(T, key.origin[None])[0]
            if not all((np.abs(part) < FAR).all() for part in placed):
                self._active.remove(m)  # the pose or the scan is wrong, and no grid spans that
                if m.size:
                    self._finish(m)
                continue
            m.submap.insert(*placed)
            m.size += 1
            m.centre = m.centre + (T[:2] - m.centre) / m.size

    def _finish(self, new: KeyframeSubmap) -> None:
        """Finish a submap that shows a change; it replaces the older ones that it covers."""
        new.submap.complete()
        if self._p.back_end.keyframes_per_place:
            covered = [m for m in self.finished if self._is_covered(m, new)]
            if self._adds_nothing(new, self.finished) and all(
                self._adds_nothing(m, [new]) for m in covered
            ):
                return
            self.finished = [m for m in self.finished if m not in covered]
        self.finished.append(new)

    def _adds_nothing(self, m: KeyframeSubmap, others: Sequence[KeyframeSubmap]) -> bool:
        """Whether other submaps have the walls of one, which would add its error to the map."""
        poses, left = self._graph.poses, m.walls
        for other in others:
            T = se2.between(other.grid_pose(poses), m.grid_pose(poses))
            middle = se2.transform(T, m.centre[None])[0]
            if math.dist(middle, other.centre) > m.reach + other.reach:
                continue
            gap, _ = other.wall_tree.query(se2.transform(T, left), distance_upper_bound=SAME_PLACE)
            left = left[np.isinf(gap)]
            if len(left) <= CHANGED * len(m.walls):
                return True
        return False

    def _is_covered(self, old: KeyframeSubmap, new: KeyframeSubmap) -> bool:
        """Whether the walls of one submap are known to another one."""
        return self._knows(new, old, old.walls)

    def _knows(self, new: KeyframeSubmap, old: KeyframeSubmap, walls: Array) -> bool:
        poses = self._graph.poses
        T = se2.between(new.grid_pose(poses), old.grid_pose(poses))
        return len(walls) > 0 and new.submap.knows(se2.transform(T, walls)) >= COVERED

    def move_anchors(self, pose: int, onto: Keyframe) -> None:
        """Keyframe ``pose`` is removed: attach its finished submaps to another keyframe."""
        for m in self.finished:
            if m.anchor.index == pose:
                grid = m.grid_pose(self._graph.poses)
                m.T_anchor_grid = se2.between(self._graph.poses[onto.index], grid)
                m.anchor = onto

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The submaps, to be saved."""
        maps = [m for m in self.finished + self._active if m.size]
        packed = [m.submap for m in maps if isinstance(m.submap, PackedSubmap)]
        cells: Any
        if packed and len(packed) == len(maps):
            shapes = [m.shape for m in packed]
            cells = Pieces(np.uint16, [m.row_of_cells for m in packed], [r * c for r, c in shapes])
        else:
            shapes = [m.submap.values.shape for m in maps]
            rows = [m.submap.values.ravel() for m in maps]
            cells = np.concatenate([np.zeros(0, dtype=np.uint16), *rows])

        def pairs(rows: Iterable[tuple[int, int]]) -> NDArray[np.int64]:
            return np.array(list(rows), dtype=np.int64).reshape(-1, 2)

        return {
            'submap_anchor': np.array([m.anchor.index for m in maps], dtype=np.int64),
            'submap_pose': np.array([m.T_anchor_grid for m in maps]).reshape(-1, 3),
            'submap_size': pairs((m.size, m.submap.insertions) for m in maps),
            'submap_centre': np.array([m.centre for m in maps]).reshape(-1, 2),
            'submap_corner': pairs(m.submap.corner for m in maps),
            'submap_shape': pairs(shapes),
            'submap_cells': cells,
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]], keys: Sequence[Keyframe]) -> None:
        """Continue with the submaps of a saved map; all are finished."""
        self.add_finished(saved_submaps(arrays, self._p.submap), keys)

    def add_finished(self, saved: Iterable[SavedSubmap], keys: Sequence[Keyframe]) -> None:
        """Finished submaps of the keyframes ``keys``, whose indices their anchors are."""
        for s in saved:
            self.finished.append(
                KeyframeSubmap(keys[s.anchor], s.submap, s.size, s.centre, s.T_anchor_grid)
            )

    def drop_covered(self, new: Sequence[KeyframeSubmap]) -> None:
        """Drop the finished submaps that one of the ``new`` ones covers, where places are few.

        Where ``keyframes_per_place`` is 0, all are kept.
        """
        if not self._p.back_end.keyframes_per_place or not new:
            return
        poses, near = self._graph.poses, self._p.loop_closure.max_distance

        def middles(maps: Sequence[KeyframeSubmap]) -> Array:
            return np.array([se2.transform(m.grid_pose(poses), m.centre[None])[0] for m in maps])

        gap = np.linalg.norm(middles(self.finished)[:, None] - middles(new), axis=-1)
        kept = []
        for m, row in zip(self.finished, gap, strict=True):
            beside = [n for n, d in zip(new, row, strict=True) if d < near and n is not m]
            walls = m.submap.walls() if beside and m not in new else np.zeros((0, 2))
            if not any(self._knows(n, m, walls) for n in beside):
                kept.append(m)
        self.finished = kept


class SavedSubmap(NamedTuple):
    """A finished submap of a map file; ``anchor`` is the index of its keyframe."""

    anchor: int
    submap: Submap
    size: int
    centre: Array
    T_anchor_grid: Array


def saved_submaps(arrays: Mapping[str, NDArray[Any]], p: params.Submap) -> Iterator[SavedSubmap]:
    """The submaps of a saved map, one at a time."""
    a, all_cells = arrays, np.asarray(arrays['submap_cells'])
    ends = np.cumsum(a['submap_shape'].prod(-1))
    for k, (rows, columns) in enumerate(a['submap_shape'].tolist()):
        submap = Submap(p)
        cells = all_cells[ends[k] - rows * columns : ends[k]]
        submap.values = cells.reshape(rows, columns).copy()
        submap.corner = (int(a['submap_corner'][k, 0]), int(a['submap_corner'][k, 1]))
        size, submap.insertions = a['submap_size'][k].tolist()
        submap.complete()
        yield SavedSubmap(
            int(a['submap_anchor'][k]), submap, size, a['submap_centre'][k].copy(),
            a['submap_pose'][k].copy(),
        )  # fmt: skip
