# SPDX-License-Identifier: Apache-2.0
"""Loop closing: search, verification and monitoring of closures, behind one class.

A closure that the scan match proposes passes four checks, each in a file of its own:

1. verification of the match: score, ambiguity ratio, degeneracy (closure_matching.py); after a
   large drift weak ones remain, which need others (weak_match.py);
2. no better placed match in another submap (closure_ambiguity.py);
3. consistency with the graph, alone or with other closures (closure_consistency.py);
4. monitoring after each solve: inconsistent ones are disabled (closure_monitor.py).

In the graph it has a robust loss besides. Rejected closures are recorded, those that lack support
stay pending; at the end they are judged by all closures together (pending_closures.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph import OnlineSolver, Renumbering, uniform
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_ambiguity import reject_ambiguous
from rlml_slam.slam.closures.closure_candidates import candidates, candidates_at
from rlml_slam.slam.closures.closure_consistency import is_consistent
from rlml_slam.slam.closures.closure_matching import UNDECIDED, ClosureMatcher, Match
from rlml_slam.slam.closures.closure_monitor import ClosureMonitor
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.constellation_closure import ConstellationMatch
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.closures.local_map import Surroundings
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.closures.pending_closures import confirmed
from rlml_slam.slam.closures.weak_match import keep_best
from rlml_slam.slam.keyframes import FoundPose, Keyframe
from rlml_slam.types import EdgeKind, Frame

Submaps = Sequence[KeyframeSubmap]

MAX_PENDING = 60  # pending closures, the newest
PENDING = 'pending: needs consistent closures from other viewpoints'
BY_REFLECTORS = 'proposed by reflectors: '
BY_SEARCH = 'found in the map: '
SAME_POSE_GATE = 16.3  # 99.9 % of chi-square with 3 degrees of freedom


class LoopCloser:
    """All loop closures of a graph; the only entry to their verification.

    ``records`` has the closures between keyframes of the graph; ``tried`` counts all accepted
    (True) and rejected (False) ones; ``changed`` if one was added since the last solve.
    ``is_due``: the newest frame has to be a keyframe, for a search has found the robot.
    """

    def __init__(self, params: Parameters, solver: OnlineSolver) -> None:
        self._p = params
        self._solver = solver
        self._graph = solver.graph
        self._matcher = ClosureMatcher(params)
        self._monitor = ClosureMonitor(params, solver.graph)
        self._pending: list[Match] = []
        self._reflector_pairs: list[tuple[int, int]] = []
        self._rejected: set[tuple[int, int]] = set()  # keyframe pairs of rejected closures
        self._num_scans = 0
        self._num_accepted = 0
        self._num_solved = 0  # closures below this number are in the estimate
        self._found: FoundPose | None = None
        self.is_due = False
        self.records = ClosureRecords()
        self.tried = {True: 0, False: 0}
        self.changed = False

    # --- proposals -----------------------------------------------------------------------------

    def follow(self, frame: Frame, found: FoundPose | None) -> None:
        """The next frame, and where a search has ``found`` the robot before it.

        Then the next frame that matches its submap is to be a keyframe, which closes a loop there.
        """
        self._found = None if frame.jumped else found or self._found
        self.is_due = self._found is not None and frame.scan_used and not frame.unconfirmed

    def search(self, key: Keyframe, points: Array, submaps: Submaps) -> tuple[Closure, ...]:
        """Closures of every n-th keyframe with ``points`` (n, 2), n the keyframe interval.

        After a large drift, weak matches with the local map count as well. Where a search has
        ``found`` the robot, the closure of this keyframe there.
        """
        p = self._p.loop_closure
        if self._found is not None:
            return self._close_at(self._found, key, points, submaps)
        self._num_scans += 1
        if not p.enabled or self._num_scans % p.keyframe_interval:
            return ()
        around = Surroundings(self._graph, self._old(key, submaps))
        return self._match(key, points, submaps, around)

    def match(self, key: Keyframe, points: Array, submaps: Submaps) -> tuple[Closure, ...]:
        """Closures of a keyframe with ``points`` (n, 2) and the finished ``submaps`` near it."""
        return self._match(key, points, submaps, None)

    def _match(
        self, key: Keyframe, points: Array, submaps: Submaps, around: Surroundings | None
    ) -> tuple[Closure, ...]:
        near = candidates(self._graph, key, submaps, self._p.loop_closure)
        results = [self._matcher.match(candidate, key, points, around) for candidate in near]
        ratio = self._p.loop_closure.ambiguity_ratio
        return self._add(keep_best(reject_ambiguous(self._graph, key, points, results, ratio)))

    def confirm(
        self, proposed: ConstellationMatch, points: Array | None, submaps: Submaps
    ) -> tuple[Closure, ...]:
        """Closure proposed by reflectors, unless the scan ``points`` (n, 2) contradicts it."""
        key = proposed.key
        anchor = KeyframeSubmap(proposed.anchor, Submap(self._p.submap), T_anchor_grid=np.zeros(3))
        information = np.asarray(np.linalg.inv(proposed.cov), dtype=np.float64)
        result: Match | Closure = Match(
            anchor, key, proposed.T_anchor_key, information, proposed.share, math.nan, math.nan,
            proposed.search_area, proposed.log_odds, BY_REFLECTORS, proposed.reflector_pairs,
        )  # fmt: skip
        # it replaces earlier proposals with the same reflectors
        new = {b for _, b in proposed.reflector_pairs}
        self._pending = [
            w for w in self._pending if new.isdisjoint(b for _, b in w.reflector_pairs)
        ]
        if points is not None:
            result = self._confirmed(proposed, result, points, submaps)
        return self._add([result])

    def _confirmed(
        self,
        proposed: ConstellationMatch,
        result: Match | Closure,
        points: Array,
        submaps: Submaps,
    ) -> Match | Closure:
        """Scan match at the proposed pose, or a rejection; ``result`` where none is possible."""
        key, T_map_key = proposed.key, proposed.T_map_key
        near = candidates_at(self._graph, self._old(key, submaps), T_map_key, self._p.loop_closure)
        if not near:
            return result
        found = self._matcher.match(near[0], key, points).result
        if isinstance(found, Closure):
            if found.why in UNDECIDED:
                return result
            return replace(found, why=BY_REFLECTORS + found.why)
        grid = found.m.grid_pose(self._graph.poses)
        off = se2.between(T_map_key, se2.compose(grid, found.T_grid_key))
        cov = se2.rotate_cov(proposed.cov, -proposed.T_anchor_key[2])
        if off @ np.linalg.solve(cov, off) > SAME_POSE_GATE:
            return found.closure(BY_REFLECTORS + 'the scan fits at another pose')
        return replace(
            found, search_area=proposed.search_area, log_odds=proposed.log_odds,
            source=BY_REFLECTORS, reflector_pairs=proposed.reflector_pairs,
        )  # fmt: skip

    def _close_at(
        self, found: FoundPose, key: Keyframe, points: Array, submaps: Submaps
    ) -> tuple[Closure, ...]:
        """The scan has to match one of the nearest old submaps there, else there is none."""
        self._found = None
        T_map_key = se2.compose(found.T_map, se2.between(found.T_local, key.T_local))
        near = candidates_at(self._graph, self._old(key, submaps), T_map_key, self._p.loop_closure)
        results = (self._matcher.match(candidate, key, points).result for candidate in near)
        fits = next((r for r in results if isinstance(r, Match)), None)
        if fits is None:
            return ()
        return self._add([replace(fits, search_area=found.area, source=BY_SEARCH)])

    def _old(self, key: Keyframe, submaps: Submaps) -> list[KeyframeSubmap]:
        """Without the newest ones, which surround the robot wherever it is."""
        newest = 2 * self._p.back_end.submap_size
        return [m for m in submaps if m.anchor.index + newest <= key.index]

    # --- verification --------------------------------------------------------------------------

    def _add(self, results: Sequence[Match | Closure]) -> tuple[Closure, ...]:
        """Add the consistent matches to the graph, and record all results."""
        matches = [r for r in results if isinstance(r, Match)]
        out = [r for r in results if isinstance(r, Closure)]
        if matches:
            tested = [*self._pending, *matches]
            out += self._accept(tested, _consistent(self._solver, tested, self._p), len(matches))
        return self._record(out)

    def decide_pending(self) -> bool:
        """At the end: whether pending ones were added that all closures together confirm."""
        right = confirmed(self._graph, self.records, self._pending, self._p)
        return bool(self._record(self._accept(self._pending, right, 0)))

    def _record(self, out: Sequence[Closure]) -> tuple[Closure, ...]:
        self.records.extend(out)
        for closure in out:
            self.tried[closure.accepted] += 1
        self._rejected.update((c.i, c.j) for c in out if not c.accepted)
        return tuple(out)

    def _accept(self, matches: list[Match], right: Sequence[bool], num_new: int) -> list[Closure]:
        """Add the ``right`` matches, the others are pending; the last ``num_new`` are new."""
        out, num_pending = [], len(matches) - num_new
        for n, (c, is_added) in enumerate(zip(matches, right, strict=True)):
            if is_added:
                why = 'consistent' if n >= num_pending else 'consistent with later closures'
                out.append(c.closure(c.source + why, self._add_edge(c), self._num_accepted))
                self._num_accepted += 1
                self._reflector_pairs += c.reflector_pairs
            elif n >= num_pending:
                out.append(c.closure(c.source + PENDING))
        accepted = {(c.i, c.j) for c in out if c.accepted} & self._rejected
        if accepted:
            self.tried[False] -= self.records.remove_rejected(accepted)
            self._rejected -= accepted
        left = [c for c, is_added in zip(matches, right, strict=True) if not is_added]
        left.sort(key=lambda c: not c.weak)  # stable: of too many, weak ones go first
        self._pending = left[-MAX_PENDING:]
        return out

    def _add_edge(self, c: Match) -> int:
        self.changed = True
        return self._graph.add_edge(EdgeKind.CLOSURE, *c.edge(self._p.loop_closure))

    def take_reflector_pairs(self) -> list[tuple[int, int]]:
        """Keys of reflectors joined by the closures that were added since the last call."""
        pairs, self._reflector_pairs = self._reflector_pairs, []
        return pairs

    # --- monitoring ----------------------------------------------------------------------------

    def needs_selection(self, final: bool = False) -> bool:
        """After a solve: whether a closure looks wrong, so that all have to be checked."""
        return self._monitor.needs_selection(self.records, final)

    def select(self) -> dict[int, bool]:
        """Enable the consistent closures and disable the others; the graph is to be solved."""
        return self._monitor.select(self.records)

    def update_states(self, enabled: Mapping[int, bool]) -> tuple[Closure, ...]:
        """States after that solve; the closures that were disabled or enabled again."""
        return self._monitor.update_states(self.records, enabled)

    def revoke(self, number: int) -> Closure:
        """Disable a closure for good; raises SolverError if there is none of this number."""
        return self._monitor.revoke(self.records, number)

    # --- bookkeeping ---------------------------------------------------------------------------

    def mark_solved(self) -> None:
        """The estimate contains all closures of the graph."""
        self.changed, self._num_solved = False, self._num_accepted

    def unsolved_edges(self) -> list[int]:
        """Edges of the closures that were added since the last solve."""
        return [c.edge for c in self.records.accepted(self._num_solved)]

    def renumber(
        self,
        new: Renumbering,
        edges: Mapping[int, int],
        poses: Mapping[int, int],
        submaps: Submaps,
    ) -> None:
        """Follow the removal of keyframes, as ClosureRecords.renumber."""
        self._pending = [
            c
            for c in self._pending
            if c.key.index not in poses
            and (c.m in submaps if c.m.size else c.m.anchor.index not in poses)
        ]
        self.records.renumber(new, edges, poses)
        self._rejected = self.records.rejected_pairs()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All closures, to be saved."""
        tried = np.array([self.tried[False], self.tried[True]], dtype=np.int64)
        return {**self.records.arrays(), 'closures_tried': tried}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the closures of a saved map."""
        self.records = ClosureRecords.from_arrays(arrays)
        self._rejected = self.records.rejected_pairs()
        self._num_accepted = max((c.number for c in self.records), default=-1) + 1
        self._num_solved = self._num_accepted
        rejected, accepted = arrays['closures_tried'].tolist()
        self.tried = {True: accepted, False: rejected}


def _consistent(solver: OnlineSolver, matches: Sequence[Match], p: Parameters) -> list[bool]:
    """Of each match, whether it is consistent with the graph, alone or with others."""
    edges = [c.edge(p.loop_closure) for c in matches]
    consistent = is_consistent(
        solver,
        np.array([(i, j) for i, j, _, _ in edges], dtype=np.int64),
        np.array([delta for _, _, delta, _ in edges]),
        np.asarray(np.linalg.inv(np.array([edge[3] for edge in edges])), dtype=np.float64),
        uniform(np.array([c.search_area for c in matches])),
        np.array([c.log_odds for c in matches]),
        np.array([c.view_range for c in matches]),
        np.array([c.weak or c.wide for c in matches]),
    )
    return [bool(c) for c in consistent]
