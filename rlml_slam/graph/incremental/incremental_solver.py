# SPDX-License-Identifier: Apache-2.0
"""Incremental least squares over a growing graph: each step costs what it changes.

A step relinearizes the factors whose linear model has become wrong, removes the cliques that they
and the new factors touch from the clique tree, with all cliques above them, orders and factors
this part again, and back-substitutes as far as variables move. In the limit of small thresholds a
step is one of Gauss-Newton on the whole graph (Kaess et al., "iSAM2: Incremental smoothing and
mapping using the Bayes tree", IJRR 31 (2012)).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rlml_slam.compiled import kernel, part
from rlml_slam.errors import SolverError
from rlml_slam.graph.incremental.affected_subtree import extract_affected
from rlml_slam.graph.incremental.back_substitution import Pool, back_substitute
from rlml_slam.graph.incremental.joint_covariance import tree_joint
from rlml_slam.graph.incremental.refactorization import make_cliques, refactor, reserve
from rlml_slam.graph.incremental.relinearization import differ, reset_references, synchronize
from rlml_slam.graph.incremental.relinearization_test import find_stale_factors, is_robust
from rlml_slam.graph.incremental.renumbering import renumber
from rlml_slam.graph.incremental.solver_state import (
    CLIQUES,
    FACTORS,
    FIXED_LANDMARKS,
    FIXED_POSES,
    FREE_CLIQUE,
    IN_USE,
    IN_USE_AT_ORDERING,
    LANDMARKS,
    LITTLE,
    POSES,
    ROWS,
    SEEDS,
    STALE,
    STEP,
    TOP,
    UNKNOWNS,
    Problem,
    State,
    Thresholds,
    compacted,
    grown_state,
    mark_affected,
    new_state,
)
from rlml_slam.graph.model.buffers import nodes_at, tables_at
from rlml_slam.graph.model.graph import Graph, Renumbering
from rlml_slam.graph.model.packed_system import Tables
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

# Status of a step; from 0 on it is an unknown at which the equations are singular.
DONE, GAUGE_CHANGED, NO_CAPACITY = -1, -2, -3
# The pool is compacted where it is this many times as large as the blocks in use. After that it is
# 5/4 as large: until the next time, as much is factored as the copy takes.
MAX_FRAGMENTATION = 2.5
# Parts that are ordered on their own fill the tree more than the whole does. The whole is ordered
# again where the tree is this many times as large as after the last time: until then, as much is
# factored as that costs.
MAX_FILL_GROWTH = 2.0


class Step(NamedTuple):
    """What one update did, as counts: the work that it took.

    ``relinearized`` factors that were stale, ``factors`` assembled, ``refactored`` poses and
    landmarks eliminated again, ``kept`` subtrees below them, ``solved`` and ``moved`` nodes.
    """

    relinearized: int
    factors: int
    refactored: int
    kept: int
    solved: int
    moved: int


@kernel
def update_tree(
    state: State, pool: Array, addresses: Ints, losses: Array, whole: bool, thresholds: Thresholds
) -> tuple[Array, int, Step]:
    """(pool, status, work done) of one step on a graph with its buffers at ``addresses``.

    The status is DONE, or the unknown at which the equations are singular, or why nothing was
    done: GAUGE_CHANGED where other nodes are fixed than before, NO_CAPACITY where the state is
    too small for the graph.
    """
    nothing = Step(0, 0, 0, 0, 0, 0)
    tables = tables_at(addresses, losses)
    if not _has_capacity(state, tables):
        return pool, NO_CAPACITY, nothing
    count = state.counts
    if differ(state.on[FIXED_POSES], tables.fixed_poses, 0, count[POSES]) or differ(
        state.on[FIXED_LANDMARKS], tables.fixed_landmarks, 0, count[LANDMARKS]
    ):
        return pool, GAUGE_CHANGED, nothing
    poses, landmarks = nodes_at(addresses)
    problem = Problem(poses, landmarks, losses, is_robust(losses), thresholds)
    count[STEP] += 1
    count[SEEDS] = 0
    synchronize(state, tables, poses, landmarks)
    whole |= count[IN_USE] > MAX_FILL_GROWTH * count[IN_USE_AT_ORDERING] + LITTLE
    if not whole and len(pool) > MAX_FRAGMENTATION * (count[IN_USE] + LITTLE):
        pool = compacted(state, pool)
    relinearized = 0
    if whole:
        relinearized = _relinearize_all(state, poses, landmarks)
    for k in range(count[STALE]):
        f = state.stale[k]
        mark_affected(state, state.factors[f]['a'])
        mark_affected(state, state.factors[f]['b'])
        relinearized += 1
    count[STALE] = 0
    if count[SEEDS] == 0:
        return pool, DONE, nothing
    affected = extract_affected(state, pool.view(np.int64))
    pool = reserve(state, pool, affected)
    numbers = pool.view(np.int64)
    of_front = make_cliques(state, numbers, affected)
    status, factors = refactor(state, pool, numbers, affected, of_front, problem)
    for n in range(len(affected.unknowns)):
        state.unknowns[affected.unknowns[n]]['local'] = -1
    if len(affected.unknowns) > 0 and len(affected.cliques) == 0:
        count[IN_USE_AT_ORDERING] = count[IN_USE]
    moved, solved = 0, 0
    if status == DONE:
        to_test = np.empty(count[UNKNOWNS], np.int64)
        solved, moved, num = back_substitute(
            state, Pool(pool, numbers), of_front, problem, to_test
        )
        find_stale_factors(state, to_test[:num], problem)
    refactored, kept = len(affected.unknowns), len(affected.cliques)
    return pool, status, Step(relinearized, factors, refactored, kept, solved, moved)


@part
def _has_capacity(state: State, tables: Tables) -> bool:
    """Whether the state has capacity for all that is in the graph."""
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
def _relinearize_all(state: State, poses: Array, landmarks: Array) -> int:
    """Discard the tree and relinearize everything; how many factors."""
    count = state.counts
    reset_references(state, poses, landmarks)
    count[CLIQUES] = count[TOP] = count[STALE] = count[IN_USE] = 0
    count[FREE_CLIQUE] = -1
    for k in range(len(state.free)):
        state.free[k] = -1
    for v in range(count[UNKNOWNS]):
        state.unknowns[v]['clique'] = state.unknowns[v]['local'] = -1
        if state.unknowns[v]['links'] > 0:
            mark_affected(state, v)
    return int(count[FACTORS])


class IncrementalSolver:
    """Incremental solver: keeps the estimate of a growing ``graph`` at the minimum of its cost.

    Add nodes and factors to the graph, or disable and enable factors (``enabled``), then call
    ``update``. New nodes enter with the estimate that they were added with; from then on only
    this object changes the estimate. Nodes that no enabled factor touches stay.
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
        """Whether no factor has to be relinearized: another update would change nothing."""
        return not self._whole and not self._state.counts[STALE]

    @property
    def is_current(self) -> bool:
        """Whether nothing in the graph has changed since the last update."""
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
        """Discard the tree: the next update starts from the estimate in the graph."""
        self._whole = True

    def update(self, whole: bool = False) -> Step:
        """One step; with ``whole`` everything is relinearized, ordered and factored again.

        Raises SolverError, naming the node, if the equations are singular; the next update then
        starts over.
        """
        graph = self.graph
        if graph.losses is not self._losses:
            self._losses, self._whole = graph.losses, True
        addresses, status = graph.addresses().at, NO_CAPACITY
        while status in (NO_CAPACITY, GAUGE_CHANGED):
            self._pool, status, step = update_tree(
                self._state, self._pool, addresses, graph.losses.codes, whole or self._whole,
                self.thresholds,
            )  # fmt: skip
            if status == GAUGE_CHANGED:
                self._forget()
            elif status == NO_CAPACITY:
                self._grow()
        self._whole = status >= 0
        if self._whole:
            node = self._state.unknowns[status]
            name = 'pose' if node['size'] == 3 else 'landmark'
            raise SolverError(
                f'normal equations are singular near {name} {node["index"]}: what it is connected '
                'to is not anchored to the map, or has too few measurements'
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
        """Follow a removal of nodes and factors from the graph (Graph.keep).

        The tree is kept where the last update came after the last change, and nothing removed had
        an enabled factor then. Else the next update starts over.
        """
        known = not self._whole and renumber(
            self._state, new.poses, new.landmarks, new.edges, new.sightings, new.pose_priors,
            new.landmark_priors,
        )  # fmt: skip
        if not known:
            self._forget()

    def _forget(self) -> None:
        """Discard all that is known of the graph."""
        self._state, self._whole = new_state(64, 64, 64, 256), True

    def _grow(self) -> None:
        """Grow to hold all that is in the graph; what is too small is doubled at least."""
        graph, state = self.graph, self._state
        tables = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
        need = (
            len(graph.poses), len(graph.landmarks), max(map(len, tables)), sum(map(len, tables)),
        )  # fmt: skip
        have = (
            len(state.of_pose), len(state.of_landmark), state.of_row.shape[1], len(state.factors),
        )  # fmt: skip
        sizes = [h if n <= h else max(n, 2 * h) for n, h in zip(need, have, strict=True)]
        self._state = grown_state(state, *sizes)


def warm_up() -> None:
    """Compile every kernel of a graph that grows and has nodes removed."""
    graph = Graph()
    solver = IncrementalSolver(graph)
    graph.add_pose([0.0, 0.0, 0.0], fixed=True)
    graph.add_landmark([1.0, 1.0])
    for k in range(2):
        graph.add_pose([k + 1.0, 0.0, 0.0])
        graph.add_edge(EdgeKind.ODOMETRY, k, k + 1, [1.0, 0.1, 0.0], np.eye(3))
        graph.add_sighting(k + 1, 0, [-k, 1.1], np.eye(2))
        solver.update()
    solver.joint([2], [0])
    solver.renumber(graph.keep(np.ones(3, dtype=np.bool_), np.ones(1, dtype=np.bool_)))
