# SPDX-License-Identifier: Apache-2.0
"""Incremental least squares over a growing graph: each step costs what it changes.

A step relinearises the factors whose linear model has become wrong, takes the cliques that they
and the new factors touch out of the tree of the factorisation, with all cliques above them, orders
and factors this part anew, and updates what feels it. In the limit of small thresholds a step is
one of Gauss-Newton on the whole graph (Kaess et al., "iSAM2", IJRR 31 (2012)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rlml_slam.compiled import kernel, part
from rlml_slam.errors import SolverError
from rlml_slam.graph.incremental.affected_subtree import take_out
from rlml_slam.graph.incremental.back_substitution import propagate
from rlml_slam.graph.incremental.joint_covariance import tree_joint
from rlml_slam.graph.incremental.refactorization import (
    make_cliques,
    refactor,
    reserve,
)
from rlml_slam.graph.incremental.relinearization import differ, refer_all, take
from rlml_slam.graph.incremental.relinearization_test import is_robust, judge
from rlml_slam.graph.incremental.renumbering import renumber
from rlml_slam.graph.incremental.solver_state import (
    CLIQUES,
    FACTORS,
    FIXED_LANDMARKS,
    FIXED_POSES,
    FREE_CLIQUE,
    IN_ONE,
    IN_USE,
    LANDMARKS,
    LISTED,
    LITTLE,
    POSES,
    ROWS,
    SEEDS,
    STEP,
    TOP,
    UNKNOWNS,
    State,
    ask,
    compacted,
    grown,
    new_state,
)
from rlml_slam.graph.model.buffers import nodes_at, tables_at
from rlml_slam.graph.model.graph import Graph, Renumbering
from rlml_slam.graph.model.packed_system import Tables
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

# What comes of a step; an unknown from 0 on is one at which the equations are singular.
DONE, OTHER, NO_ROOM = -1, -2, -3
# Beyond this many times the room of the blocks in use, the pool is made anew without gaps: from
# 5/4 of it, as much has been factored by then as that takes to copy.
SCATTERED = 2.5
# Parts that are ordered on their own fill the tree more than the whole does. Beyond this many
# times the room that it took when it was ordered as a whole, or for a graph that has grown as
# much, it is again: as much has been factored by then as that costs.
FILLED = 2.0


@dataclass(frozen=True)
class Thresholds:
    """How far off things may be before something is done about it.

    A factor is relinearised when its linear model is off by ``due`` standard deviations, its pose
    has turned by ``turn`` [rad] or its robust weight changed by that share, else only where it has
    to be assembled anyway. A move of a variable by less than ``still`` standard deviations is not
    passed on.
    """

    due: float = 0.05
    turn: float = 0.1
    still: float = 0.02


class Step(NamedTuple):
    """What one update did, as counts: the work that it took.

    ``relinearized`` factors that were due, ``factors`` assembled, ``refactored`` poses and
    landmarks eliminated anew, ``kept`` subtrees below them, ``solved`` and ``moved`` nodes.
    """

    relinearized: int
    factors: int
    refactored: int
    kept: int
    solved: int
    moved: int


@kernel
def advance(
    state: State, pool: Array, places: Ints, losses: Array, whole: bool, due: float, turn: float,
    still: float,
) -> tuple[Array, int, Step]:  # fmt: skip
    """(pool, what came of it, what was done) of one step on a graph at ``places``.

    What came of it is DONE, or the unknown at which the equations are singular, or why nothing
    was done: OTHER nodes are fixed than before, or there is NO_ROOM for all that is in the graph.
    """
    nothing = Step(0, 0, 0, 0, 0, 0)
    tables = tables_at(places, losses)
    if not _fits(state, tables):
        return pool, NO_ROOM, nothing
    count = state.counts
    if differ(state.on[FIXED_POSES], tables.fixed_poses, 0, count[POSES]) or differ(
        state.on[FIXED_LANDMARKS], tables.fixed_landmarks, 0, count[LANDMARKS]
    ):
        return pool, OTHER, nothing
    poses, landmarks = nodes_at(places)
    count[STEP] += 1
    count[SEEDS] = 0
    take(state, tables, poses, landmarks)
    whole |= count[IN_USE] > FILLED * count[IN_ONE] + LITTLE
    if not whole and len(pool) > SCATTERED * (count[IN_USE] + LITTLE):
        pool = compacted(state, pool)
    relinearized = 0
    if whole:
        relinearized = _start_over(state, poses, landmarks)
    for k in range(count[LISTED]):
        f = state.due[k]
        ask(state, state.factors[f]['a'])
        ask(state, state.factors[f]['b'])
        relinearized += 1
    count[LISTED] = 0
    if count[SEEDS] == 0:
        return pool, DONE, nothing
    anew = take_out(state, pool.view(np.int64))
    pool = reserve(state, pool, anew)
    numbers = pool.view(np.int64)
    of_front = make_cliques(state, numbers, anew)
    failed, factors = refactor(
        state, pool, numbers, anew, of_front, losses, poses, landmarks, due, turn
    )
    for n in range(len(anew.unknowns)):
        state.unknowns[anew.unknowns[n]]['local'] = -1
    if len(anew.unknowns) > 0 and len(anew.cliques) == 0:
        count[IN_ONE] = count[IN_USE]
    moved, solved = 0, 0
    if failed == DONE:
        who = np.empty(count[UNKNOWNS], np.int64)
        solved, moved, restless = propagate(
            state, pool, numbers, of_front, is_robust(losses), poses, landmarks, still, who
        )
        judge(state, who[:restless], losses, poses, landmarks, due, turn)
    work = Step(relinearized, factors, len(anew.unknowns), len(anew.cliques), solved, moved)
    return pool, failed, work


@part
def _fits(state: State, tables: Tables) -> bool:
    """Whether there is room for all that is in the graph."""
    most, total = 0, 0
    for table in (tables.edges, tables.sightings, tables.pose_priors, tables.landmark_priors):
        most = max(most, len(table.nodes))
        total += len(table.nodes)
    return (
        len(tables.fixed_poses) <= len(state.of_pose)
        and len(tables.fixed_landmarks) <= len(state.of_landmark)
        and most <= state.of_row.shape[1]
        and total <= len(state.factors)
    )


@part
def _start_over(state: State, poses: Array, landmarks: Array) -> int:
    """Forget the tree and relinearise everything; how many factors."""
    count = state.counts
    refer_all(state, poses, landmarks)
    count[CLIQUES] = count[TOP] = count[LISTED] = count[IN_USE] = 0
    count[FREE_CLIQUE] = -1
    for k in range(len(state.free)):
        state.free[k] = -1
    for v in range(count[UNKNOWNS]):
        state.unknowns[v]['clique'] = state.unknowns[v]['local'] = -1
        if state.unknowns[v]['links'] > 0:
            ask(state, v)
    return int(count[FACTORS])


class Incremental:
    """Keeps the estimate in ``graph`` at the minimum of its cost while the graph grows.

    Add nodes and factors to the graph, or switch factors off and on (``enabled``), then call
    ``update``. New nodes enter with the estimate that they were added with; from then on the
    estimate is this object's to change. Nodes that no enabled factor touches stay.
    """

    def __init__(self, graph: Graph, thresholds: Thresholds | None = None) -> None:
        self.graph = graph
        self.thresholds = thresholds or Thresholds()
        self._losses = graph.losses
        self._state = new_state(64, 64, 64, 256)
        self._pool = np.empty(LITTLE)
        self._whole = False

    @property
    def settled(self) -> bool:
        """Whether no factor waits to be relinearised: another update would change nothing."""
        return not self._whole and not self._state.counts[LISTED]

    @property
    def is_current(self) -> bool:
        """Whether the last update knew all that is in the graph now."""
        graph, state = self.graph, self._state
        tables = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
        now = len(graph.poses), len(graph.landmarks), *map(len, tables)
        return (
            not self._whole
            and graph.losses is self._losses
            and tuple(state.counts[: ROWS + 4].tolist()) == now
            and all(
                np.array_equal(known[: len(flags)], flags)
                for known, flags in zip(
                    state.on,
                    (*(t.enabled for t in tables), graph.fixed_poses, graph.fixed_landmarks),
                    strict=True,
                )
            )
        )

    def start_over(self) -> None:
        """The estimate in the graph was changed: the next update takes it as it is."""
        self._whole = True

    def update(self, whole: bool = False) -> Step:
        """One step; with ``whole`` everything is relinearised, ordered and factored anew.

        Raises SolverError, naming the node, if the equations are singular; the next update then
        starts over.
        """
        graph, limits = self.graph, self.thresholds
        if graph.losses is not self._losses:
            self._losses, self._whole = graph.losses, True
        places, failed = graph.places().at, NO_ROOM
        while failed in (NO_ROOM, OTHER):
            self._pool, failed, step = advance(
                self._state, self._pool, places, graph.losses.codes, whole or self._whole,
                limits.due, limits.turn, limits.still,
            )  # fmt: skip
            if failed == OTHER:
                self._forget()
            elif failed == NO_ROOM:
                self._make_room()
        self._whole = failed >= 0
        if self._whole:
            node = self._state.unknowns[failed]
            name = 'pose' if node['size'] == 3 else 'landmark'
            raise SolverError(
                f'normal equations are singular near {name} {node["index"]}: what it is connected '
                'to is not tied to the map, or has too few measurements'
            )
        return step

    def joint(self, poses: ArrayLike, landmarks: ArrayLike = ()) -> Array:
        """Joint covariance (3k + 2l, 3k + 2l) of the poses (k,), then the landmarks (l,).

        As that of Marginals, at the linear models of the last update; what is new since then has
        no covariance.
        """
        state, at = self._state, []
        for of, known, nodes in (
            (state.of_pose, state.counts[POSES], poses),
            (state.of_landmark, state.counts[LANDMARKS], landmarks),
        ):
            k = np.asarray(nodes, dtype=np.int64).reshape(-1)
            at.append(np.where(k < known, of[np.minimum(k, len(of) - 1)], -1))
        sizes = np.repeat([3, 2], [len(at[0]), len(at[1])])
        unknowns = np.concatenate(at)
        free = (unknowns >= 0) & (state.unknowns['clique'][unknowns] >= 0)
        rows = np.flatnonzero(np.repeat(free, sizes))
        out = np.zeros((sizes.sum(), sizes.sum()))
        if len(rows):
            out[np.ix_(rows, rows)] = tree_joint(state, self._pool, unknowns[free])
        return out

    def renumber(self, new: Renumbering) -> None:
        """The graph has let go of nodes and factors (Graph.keep).

        It is cheap where an update came between the last change and that, in which nothing that
        goes had an enabled factor any more. Else the next update starts over.
        """
        known = not self._whole and renumber(
            self._state, new.poses, new.landmarks, new.edges, new.sightings, new.pose_priors,
            new.landmark_priors,
        )  # fmt: skip
        if not known:
            self._forget()

    def _forget(self) -> None:
        """Nothing is known of the graph."""
        self._state, self._whole = new_state(64, 64, 64, 256), True

    def _make_room(self) -> None:
        """Make room for all that is in the graph, and for as much again where there was none."""
        graph, state = self.graph, self._state
        tables = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
        need = (
            len(graph.poses), len(graph.landmarks), max(map(len, tables)), sum(map(len, tables)),
        )  # fmt: skip
        have = (
            len(state.of_pose), len(state.of_landmark), state.of_row.shape[1], len(state.factors),
        )  # fmt: skip
        sizes = [h if n <= h else max(n, 2 * h) for n, h in zip(need, have, strict=True)]
        self._state = grown(state, *sizes)


def warm_up() -> None:
    """Compile every kernel of a graph that grows and lets go of nodes."""
    graph = Graph()
    solver = Incremental(graph)
    graph.add_pose([0.0, 0.0, 0.0], fixed=True)
    graph.add_landmark([1.0, 1.0])
    for k in range(2):
        graph.add_pose([k + 1.0, 0.0, 0.0])
        graph.add_edge(EdgeKind.ODOMETRY, k, k + 1, [1.0, 0.1, 0.0], np.eye(3))
        graph.add_sighting(k + 1, 0, [-k, 1.1], np.eye(2))
        solver.update()
    solver.joint([2], [0])
    solver.renumber(graph.keep(np.ones(3, dtype=np.bool_), np.ones(1, dtype=np.bool_)))
