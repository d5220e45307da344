# SPDX-License-Identifier: Apache-2.0
"""Scans in the graph: keyframes tied to submaps as they are built, and to finished ones later.

A closure is searched by branch and bound over the whole window, refined, and verified by its score
and by the lead over the second-best place. It enters where the graph expects it, or with others
that agree (closure_entry.py); what fails is recorded, not used, and what agrees with nothing yet
waits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factors import relative_information
from rlml_slam.graph.model.graph import Renumbering
from rlml_slam.graph.robust.inlier_evidence import uniform
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.scan_match import match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_ambiguity import is_distinct
from rlml_slam.slam.closures.closure_candidates import Candidate, candidates
from rlml_slam.slam.closures.closure_consistency import is_consistent
from rlml_slam.slam.closures.closure_matching import OPEN, UNDECIDED, Match, Matcher
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.constellation_closure import Place
from rlml_slam.slam.closures.keyframe_submap import TURN, KeyframeSubmap
from rlml_slam.slam.closures.loop_closure import Closure, Fate, State
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind

COVERED = 0.8  # share of a submap's walls that a newer one must know to take its place
WAITING = 60  # closures that wait for others to agree with them, the newest
WAITS = 'waits for others that agree'
BY_REFLECTORS = 'proposed by reflectors: '
ELSEWHERE = 16.3  # 99.9 % of a chi-square with 3 degrees of freedom
CONFIRMED = 1.0, 0.2  # [m], [rad] around the place that reflectors tell, where its scan has to fit


class ScanGraph:
    """Scan edges and loop closures of the back end.

    ``closures`` are the records of those between keyframes that are still there; ``tried`` counts
    all that were accepted (True) and rejected (False).
    """

    def __init__(self, params: Parameters, live: OnlineSolver) -> None:
        self._p = params
        self._live = live
        self._graph = live.graph
        self._active: list[KeyframeSubmap] = []
        self._finished: list[KeyframeSubmap] = []
        self._matcher = Matcher(params)
        self._waiting: list[Match] = []
        self._paired: list[tuple[int, int]] = []
        self._failed: set[tuple[int, int]] = set()  # keyframes of rejected closures
        self._count = 0
        self._accepted = 0
        self.closures = ClosureRecords()
        self.tried = {True: 0, False: 0}
        self.changed = False
        self._solved = 0  # closures below this number are in the estimate

    def add(self, key: Keyframe) -> tuple[Closure, ...]:
        """Tie a keyframe to the submaps being built, insert it, look for closures."""
        assert key.points is not None
        assert key.origin is not None
        if len(key.points) < self._p.scan_match.min_points:
            return ()
        whole = key.points.astype(np.float64)
        points = voxel_filter.thin(
            whole, self._p.scan_match.voxel_size, self._p.scan_match.max_points
        )
        p = self._p.submap
        for m in self._active:
            self._tie(m, key, points)
        self._insert(key, voxel_filter.thin(whole, p.resolution, p.max_points))
        self._count += 1
        if (
            not self._p.loop_closure.enabled
            or self._count % self._p.loop_closure.keyframe_interval
        ):
            return ()
        return self._close(key, points, self._finished)

    def link(self, key: Keyframe, before: int) -> tuple[Closure, ...]:
        """Closures of a keyframe with finished submaps that begin before keyframe ``before``."""
        if key.points is None or len(key.points) < self._p.scan_match.min_points:
            return ()
        p, whole = self._p.scan_match, key.points.astype(np.float64)
        among = [m for m in self._finished if m.anchor.index < before]
        return self._close(key, voxel_filter.thin(whole, p.voxel_size, p.max_points), among)

    def begin_piece(self) -> None:
        """Complete the submaps that are being built: the robot goes on from elsewhere."""
        for m in self._active:
            self._complete(m)
        self._active = []

    @property
    def num_submaps(self) -> int:
        """How many there are, those that are being built among them."""
        return len(self._finished) + len(self._active)

    @property
    def oldest_active(self) -> int | None:
        """Index of the first keyframe that a submap being built needs, None without any."""
        return min((m.anchor.index for m in self._active), default=None)

    def finish(self) -> None:
        """Nothing is held back for the end."""

    def _tie(self, m: KeyframeSubmap, key: Keyframe, points: Array) -> None:
        """A scan edge from the submap's anchor, where the scan fits."""
        if not m.size:
            return
        guess = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
        prior = np.diag(1.0 / np.array(self._p.back_end.match_sigma) ** 2)
        p = self._p.scan_match
        found = match(m.submap, points, guess, prior, p, searched=False)
        if found.score < p.min_score or key.index == m.anchor.index:
            return
        information = scan_information.information(m.submap, points, found.pose, p)
        self._edge(EdgeKind.SCAN, m, key, found.pose, information)

    def _edge(
        self,
        kind: EdgeKind,
        m: KeyframeSubmap,
        key: Keyframe,
        T_grid_key: Array,
        information: Array,
    ) -> int:
        self.changed |= kind is EdgeKind.CLOSURE
        delta, information = self._measured(kind, m.T_anchor_grid, T_grid_key, information)
        return self._graph.add_edge(kind, m.anchor.index, key.index, delta, information)

    def _measured(
        self, kind: EdgeKind, T_anchor_grid: Array, T_grid_key: Array, information: Array
    ) -> tuple[Array, Array]:
        """Keyframes' places (..., 3) from submaps' anchors, and informations of the residuals."""
        # a direction that the scan leaves open still needs a covariance, and a regular one
        cov = np.linalg.inv(information + OPEN * np.eye(3))
        R = np.zeros_like(cov)
        R[..., :2, :2], R[..., 2, 2] = se2.rotation(T_anchor_grid[..., 2]), 1.0
        cov = R @ cov @ np.swapaxes(R, -1, -2)
        delta = se2.compose(T_anchor_grid, T_grid_key)
        closure = kind is EdgeKind.CLOSURE
        floor2 = (
            self._p.loop_closure.variance_floor
            if closure
            else self._p.back_end.scan_edge_variance_floor
        )
        cov[..., [0, 1, 2], [0, 1, 2]] += floor2
        return delta, relative_information(delta, cov)

    def _insert(self, key: Keyframe, points: Array) -> None:
        size = self._p.back_end.submap_size
        if self._active and self._active[0].size >= size and len(self._active) > 1:
            self._complete(self._active.pop(0))
        if not self._active or (len(self._active) == 1 and self._active[0].size >= size // 2):
            self._active.append(KeyframeSubmap(key, Submap(self._p.submap)))
        for m in self._active:
            # inside one submap the front end's path is smoother than the graph's
            T = se2.between(se2.compose(m.anchor.T_local, TURN), key.T_local)
            assert key.origin is not None
            m.submap.insert(se2.transform(T, points), se2.transform(T, key.origin[None])[0])
            m.size += 1
            m.centre = m.centre + (T[:2] - m.centre) / m.size

    def _complete(self, new: KeyframeSubmap) -> None:
        """A submap is built: it takes the place of those that show nothing else."""
        new.submap.complete()
        if self._p.back_end.keyframes_per_place:
            self._finished = [m for m in self._finished if not self._is_covered(m, new)]
        self._finished.append(new)

    def _is_covered(self, old: KeyframeSubmap, new: KeyframeSubmap) -> bool:
        """Whether what one submap shows is known to another one as well."""
        T = se2.between(self._grid(new), self._grid(old))
        return len(old.walls) > 0 and new.submap.knows(se2.transform(T, old.walls)) >= COVERED

    def solved(self) -> None:
        """The estimate has all that is in the graph now."""
        self.changed, self._solved = False, self._accepted

    def unsolved(self) -> list[int]:
        """Edges of the closures that came since: where the estimate is, they count for little."""
        return [c.edge for c in self.closures.accepted(self._solved)]

    def take_over(self, pose: int, onto: Keyframe) -> None:
        """Keyframe ``pose`` goes: let submaps that stand on it stand on another one."""
        for m in self._finished:
            if m.anchor.index == pose:
                m.T_anchor_grid = se2.between(self._pose(onto), self._grid(m))
                m.anchor = onto

    def renumber(
        self, new: Renumbering, edges: Mapping[int, int], poses: Mapping[int, int]
    ) -> None:
        """The graph has let go of keyframes, as ClosureRecords.renumber has it."""
        self._waiting = [
            c
            for c in self._waiting
            if c.key.index not in poses
            and (c.m in self._finished if c.m.size else c.m.anchor.index not in poses)
        ]
        self.closures.renumber(new, edges, poses)
        self._failed = self.closures.failed()

    def _pose(self, key: Keyframe) -> Array:
        pose: Array = self._graph.poses[key.index]
        return pose

    def _grid(self, m: KeyframeSubmap) -> Array:
        return se2.compose(self._pose(m.anchor), m.T_anchor_grid)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The submaps and the records of closures, to be saved."""
        maps = [m for m in self._finished + self._active if m.size]
        cells = [m.submap.values.ravel() for m in maps]
        c = self.closures

        def pairs(rows: Iterable[tuple[int, int]]) -> NDArray[np.int64]:
            return np.array(list(rows), dtype=np.int64).reshape(-1, 2)

        return {
            'submap_anchor': np.array([m.anchor.index for m in maps], dtype=np.int64),
            'submap_pose': np.array([m.T_anchor_grid for m in maps]).reshape(-1, 3),
            'submap_size': pairs((m.size, m.submap.insertions) for m in maps),
            'submap_centre': np.array([m.centre for m in maps]).reshape(-1, 2),
            'submap_corner': pairs(m.submap.corner for m in maps),
            'submap_shape': pairs(m.submap.values.shape for m in maps),
            'submap_cells': np.concatenate([np.zeros(0, dtype=np.uint16), *cells]),
            'closure': np.array([(r.i, r.j, r.edge) for r in c], dtype=np.int64).reshape(-1, 3),
            'closure_fit': np.array([(*r.delta, r.score, r.overlap, r.second) for r in c]).reshape(
                -1, 6
            ),
            'closure_why': np.array([r.why for r in c], dtype=np.str_),
            'closure_fate': pairs((r.number, r.fate.state.value) for r in c),
            'closure_reason': np.array([r.fate.reason for r in c], dtype=np.str_),
            'closures_tried': np.array([self.tried[False], self.tried[True]], dtype=np.int64),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]], keys: Sequence[Keyframe]) -> None:
        """Take over what was saved: all submaps are complete."""
        a = arrays
        ends = np.cumsum(a['submap_shape'].prod(-1))
        for k, (rows, columns) in enumerate(a['submap_shape'].tolist()):
            submap = Submap(self._p.submap)
            cells = a['submap_cells'][ends[k] - rows * columns : ends[k]]
            submap.values = cells.reshape(rows, columns).copy()
            submap.corner = (int(a['submap_corner'][k, 0]), int(a['submap_corner'][k, 1]))
            size, submap.insertions = a['submap_size'][k].tolist()
            submap.complete()
            self._finished.append(
                KeyframeSubmap(
                    keys[int(a['submap_anchor'][k])], submap, size,
                    a['submap_centre'][k].copy(), a['submap_pose'][k].copy(),
                )
            )  # fmt: skip
        self.closures = ClosureRecords(
            Closure(
                i, j, fit[:3], float(fit[3]), edge, str(why), float(fit[4]), float(fit[5]), number,
                Fate(State(state), str(reason)),
            )
            for (i, j, edge), fit, why, (number, state), reason in zip(
                a['closure'].tolist(), a['closure_fit'], a['closure_why'],
                a['closure_fate'].tolist(), a['closure_reason'], strict=True
            )
        )  # fmt: skip
        self._failed = self.closures.failed()
        self._accepted = max((c.number for c in self.closures), default=-1) + 1
        self._solved = self._accepted
        rejected, accepted = a['closures_tried'].tolist()
        self.tried = {True: accepted, False: rejected}

    def _close(
        self, key: Keyframe, points: Array, among: Sequence[KeyframeSubmap]
    ) -> tuple[Closure, ...]:
        """Try those ``among`` finished submaps that are near the keyframe."""
        near = candidates(self._graph, key, among, self._p.loop_closure)
        tried = [self._matcher.match(candidate, key, points) for candidate in near]
        share = self._p.loop_closure.ambiguity_ratio
        return self._record(is_distinct(self._graph, key, points, tried, share))

    def enter(self, place: Place) -> tuple[Closure, ...]:
        """Close the loop to a place that reflectors tell, unless the scan says otherwise."""
        key, here = place.key, place.T_map_key
        anchor = KeyframeSubmap(place.anchor, Submap(self._p.submap), T_anchor_grid=np.zeros(3))
        information = np.asarray(np.linalg.inv(place.cov), dtype=np.float64)
        confirmed: Match | Closure = Match(
            anchor, key, place.T_anchor_key, information, place.share, math.nan, math.nan,
            place.area, place.odds, BY_REFLECTORS, place.pairs,
        )  # fmt: skip
        # what was told of the same reflectors before is told again, not once more
        fresh = {new for _, new in place.pairs}
        self._waiting = [w for w in self._waiting if fresh.isdisjoint(n for _, n in w.pairs)]
        # the robot's own last submaps are where it is, whatever that is of the old ones
        size = self._p.back_end.submap_size
        old = [m for m in self._finished if m.anchor.index + 2 * size <= key.index]
        gaps = [math.dist(se2.transform(self._grid(m), m.centre[None])[0], here[:2]) for m in old]
        p, scanned = self._p, key.points is not None
        if key.points is not None and len(key.points) < p.scan_match.min_points:
            scanned = False
        if scanned and gaps and min(gaps) < p.loop_closure.max_distance:
            assert key.points is not None
            m = old[int(np.argmin(gaps))]
            points = voxel_filter.thin(
                key.points.astype(np.float64), p.scan_match.voxel_size, p.scan_match.max_points
            )
            candidate = Candidate(m, se2.between(self._grid(m), here), *CONFIRMED)
            found = self._matcher.match(candidate, key, points).result
            if isinstance(found, Match):
                confirmed = replace(
                    found, searched=place.area, odds=place.odds, source=BY_REFLECTORS,
                    pairs=place.pairs,
                )  # fmt: skip
                off = se2.between(here, se2.compose(self._grid(m), found.T_grid_key))
                R = np.eye(3)
                R[:2, :2] = se2.rotation(place.T_anchor_key[2])
                if off @ np.linalg.solve(R.T @ place.cov @ R, off) > ELSEWHERE:
                    confirmed = found.closure(BY_REFLECTORS + 'the scan fits elsewhere')
            elif found.why not in UNDECIDED:
                confirmed = replace(found, why=BY_REFLECTORS + found.why)
        return self._record([confirmed])

    def take_pairs(self) -> list[tuple[int, int]]:
        """Keys of reflectors that are one by the closures that entered since the last call."""
        pairs, self._paired = self._paired, []
        return pairs

    def _record(self, tried: Sequence[Match | Closure]) -> tuple[Closure, ...]:
        """Let in what may, and remember all."""
        fit = [match for match in tried if isinstance(match, Match)]
        out = [closure for closure in tried if isinstance(closure, Closure)]
        if fit:
            out += self._admit(fit)
        self.closures.extend(out)
        for closure in out:
            self.tried[closure.accepted] += 1
        self._failed.update((c.i, c.j) for c in out if not c.accepted)
        return tuple(out)

    def _admit(self, fresh: Sequence[Match]) -> list[Closure]:
        """Let in what may, of the ``fresh`` ones and those that waited; the others wait."""
        matches = [*self._waiting, *fresh]
        nodes = np.array([(c.m.anchor.index, c.key.index) for c in matches], dtype=np.int64)
        deltas, informations = self._measured(
            EdgeKind.CLOSURE,
            np.array([c.m.T_anchor_grid for c in matches]),
            np.array([c.T_grid_key for c in matches]),
            np.array([c.information for c in matches]),
        )
        covs: Array = np.asarray(np.linalg.inv(informations), dtype=np.float64)
        wrong = uniform(np.array([c.searched for c in matches]))
        odds = np.array([c.odds for c in matches])
        sight = np.array([c.sight for c in matches])
        may = is_consistent(self._live, nodes, deltas, covs, wrong, odds, sight)
        out, waited = [], len(self._waiting)
        for n, (c, enters) in enumerate(zip(matches, may.tolist(), strict=True)):
            if enters:
                self._paired += c.pairs
                edge = self._edge(EdgeKind.CLOSURE, c.m, c.key, c.T_grid_key, c.information)
                why = 'fits' if n >= waited else 'fits and others agree'
                out.append(c.closure(c.source + why, edge, self._accepted))
                self._accepted += 1
            elif n >= waited:
                out.append(c.closure(c.source + WAITS))
        entered = {(c.i, c.j) for c in out if c.accepted} & self._failed
        if entered:
            self.tried[False] -= self.closures.take_back(entered)
            self._failed -= entered
        left = [c for c, enters in zip(matches, may.tolist(), strict=True) if not enters]
        self._waiting = left[-WAITING:]
        return out
