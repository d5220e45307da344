# SPDX-License-Identifier: Apache-2.0
"""Renumbering of the incremental solver after nodes and factors were removed from its graph."""

from __future__ import annotations

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.incremental.solver_state import (
    EDGES,
    FIXED_LANDMARKS,
    FIXED_POSES,
    FREE_FACTOR,
    FREE_UNKNOWN,
    LANDMARK_PRIORS,
    LANDMARKS,
    POSE_PRIORS,
    POSES,
    ROWS,
    SIGHTINGS,
    State,
)
from rlml_slam.graph.sparse.symbolic_analysis import Ints


@kernel
def renumber(
    state: State, poses: Ints, landmarks: Ints, edges: Ints, sightings: Ints, pose_priors: Ints,
    landmark_priors: Ints,
) -> bool:  # fmt: skip
    """Apply the new indices of nodes and factors, -1 for those removed.

    False, and nothing was done, where the graph has something new that the solver does not know,
    or where something removed is still part of the tree.
    """
    count = state.counts
    if not (
        _are_free(state, state.of_pose, count[POSES], poses)
        and _are_free(state, state.of_landmark, count[LANDMARKS], landmarks)
        and _are_disabled(state, EDGES, edges)
        and _are_disabled(state, SIGHTINGS, sightings)
        and _are_disabled(state, POSE_PRIORS, pose_priors)
        and _are_disabled(state, LANDMARK_PRIORS, landmark_priors)
    ):
        return False
    count[POSES] = _move_nodes(state, state.of_pose, FIXED_POSES, poses)
    count[LANDMARKS] = _move_nodes(state, state.of_landmark, FIXED_LANDMARKS, landmarks)
    _move_rows(state, EDGES, edges, poses, poses)
    _move_rows(state, SIGHTINGS, sightings, poses, landmarks)
    _move_rows(state, POSE_PRIORS, pose_priors, poses, poses)
    _move_rows(state, LANDMARK_PRIORS, landmark_priors, poses, landmarks)
    return True


@part
def _are_free(state: State, of: Ints, known: int, new: Ints) -> bool:
    """Whether all nodes are known, and no enabled factor is on those removed."""
    if known != len(new):
        return False
    for i in range(known):
        if new[i] < 0 and of[i] >= 0:
            u = state.unknowns[of[i]]
            if u['links'] > 0 or u['clique'] >= 0:
                return False
    return True


@part
def _are_disabled(state: State, table: int, new: Ints) -> bool:
    """Whether all rows of a table are known, and those removed are disabled."""
    if state.counts[ROWS + table] != len(new):
        return False
    off = True
    for r in range(len(new)):
        off &= new[r] >= 0 or not state.on[table, r]
    return off


@part
def _move_nodes(state: State, of: Ints, fixed: int, new: Ints) -> int:
    """Move the unknowns and the flags of nodes to lower indices. How many nodes there are."""
    num = 0
    for i in range(len(new)):
        v = of[i]
        if new[i] >= 0:
            of[new[i]] = v
            state.on[fixed, new[i]] = state.on[fixed, i]
            num += 1
            if v >= 0:
                state.unknowns[v]['index'] = new[i]
        elif v >= 0:
            state.unknowns[v]['index'] = 0
            state.unknowns[v]['head'] = state.counts[FREE_UNKNOWN]
            state.counts[FREE_UNKNOWN] = v
    return num


@part
def _move_rows(state: State, table: int, new: Ints, of_i: Ints, of_j: Ints) -> None:
    num = 0
    for r in range(len(new)):
        f = state.of_row[table, r]
        z = state.factors[f]
        if new[r] >= 0:
            state.of_row[table, new[r]] = f
            state.on[table, new[r]] = state.on[table, r]
            z['j'] = of_j[z['j']]
            if z['i'] >= 0:
                z['i'] = of_i[z['i']]
            num += 1
        else:
            z['after'] = state.counts[FREE_FACTOR]
            state.counts[FREE_FACTOR] = f
    state.counts[ROWS + table] = num
