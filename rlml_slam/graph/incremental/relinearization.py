# SPDX-License-Identifier: Apache-2.0
"""Factors of the incremental solver: synchronized with the graph, and linearized.

The coordinates are the raw ones of factors.py, so a factor's linear model stays a function of the
estimate itself and each factor has a linearization point of its own.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.graph.incremental.relinearization_test import restrict_validity, squared, valid_turn
from rlml_slam.graph.incremental.solver_state import (
    EDGES,
    FIXED_LANDMARKS,
    FIXED_POSES,
    LANDMARK_PRIORS,
    LANDMARKS,
    POSE_PRIORS,
    POSES,
    ROWS,
    SIGHTINGS,
    STEP,
    UNKNOWNS,
    Problem,
    State,
    allocate_factor,
    allocate_unknown,
    mark_affected,
)
from rlml_slam.graph.model.factors import (
    axes,
    is_curved,
    linear_change,
    residual,
    rotate,
    rotate_back,
)
from rlml_slam.graph.model.packed_system import Factors, Flags, Tables
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.se2 import Array, wrapped_by_turns


@part
def synchronize(state: State, tables: Tables, poses: Array, landmarks: Array) -> None:
    """Add the new nodes and factors of the graph, and follow what was enabled or disabled."""
    count = state.counts
    for i in range(count[POSES], len(poses)):
        state.of_pose[i] = -1
        state.on[FIXED_POSES, i] = tables.fixed_poses[i]
        if not tables.fixed_poses[i]:
            state.of_pose[i] = _new_unknown(state, 3, i)
            _set_reference(state, state.of_pose[i], poses[i, 0], poses[i, 1], poses[i, 2])
    count[POSES] = len(poses)
    for i in range(count[LANDMARKS], len(landmarks)):
        state.of_landmark[i] = -1
        state.on[FIXED_LANDMARKS, i] = tables.fixed_landmarks[i]
        if not tables.fixed_landmarks[i]:
            state.of_landmark[i] = _new_unknown(state, 2, i)
            _set_reference(state, state.of_landmark[i], landmarks[i, 0], landmarks[i, 1], 0.0)
    count[LANDMARKS] = len(landmarks)
    _synchronize_factors(state, EDGES, tables.edges)
    _synchronize_factors(state, SIGHTINGS, tables.sightings)
    _synchronize_factors(state, POSE_PRIORS, tables.pose_priors)
    _synchronize_factors(state, LANDMARK_PRIORS, tables.landmark_priors)


@part
def _new_unknown(state: State, size: int, index: int) -> int:
    v = allocate_unknown(state.unknowns, state.counts)
    u = state.unknowns[v]
    u['size'], u['index'] = size, index
    u['clique'] = u['head'] = u['local'] = -1
    u['links'] = 0
    u['affected'] = u['last_change'] = u['moved'] = 0
    u['position_info'] = u['heading_info'] = 0.0
    return v


@part
def _set_reference(state: State, v: int, x: float, y: float, theta: float) -> None:
    """Make this estimate the reference, where d = 0."""
    u = state.unknowns[v]
    u['x'], u['y'], u['theta'] = x, y, theta
    u['valid_low'], u['valid_high'] = -np.inf, np.inf
    u['dx'] = u['dy'] = u['dtheta'] = u['sx'] = u['sy'] = u['stheta'] = 0.0


@part
def reset_references(state: State, poses: Array, landmarks: Array) -> None:
    """Make the current estimate the reference of all unknowns."""
    for v in range(state.counts[UNKNOWNS]):
        i = state.unknowns[v]['index']
        if state.unknowns[v]['size'] == 3:
            _set_reference(state, v, poses[i, 0], poses[i, 1], poses[i, 2])
        else:
            _set_reference(state, v, landmarks[i, 0], landmarks[i, 1], 0.0)


@part
def _synchronize_factors(state: State, table: int, factors: Factors) -> None:
    known: int = state.counts[ROWS + table]
    rows = len(factors.nodes)
    on = state.on[table]
    # 64 flags at a time, which the compiler turns into one comparison
    for start in range(0, known, 64):
        end = min(start + 64, known)
        if differ(on, factors.enabled, start, end):
            for r in range(start, end):
                if on[r] != factors.enabled[r]:
                    on[r] = not on[r]
                    _set_enabled(state, state.of_row[table, r], on[r])
    for r in range(known, rows):
        f = allocate_factor(state.factors, state.counts)
        state.of_row[table, r] = f
        _pack_factor(state, f, table, factors, r)
        on[r] = factors.enabled[r]
        if on[r]:
            _set_enabled(state, f, True)
    state.counts[ROWS + table] = rows


@part
def differ(a: Flags, b: Flags, start: int, end: int) -> bool:
    """Whether flags between two indices differ."""
    different = False
    for r in range(start, end):
        different |= a[r] != b[r]
    return different


@part
def _pack_factor(state: State, f: int, table: int, factors: Factors, r: int) -> None:
    """Row r of a table into record f."""
    z, nodes = state.factors[f], factors.nodes
    measured, info = factors.measured, factors.information
    z['table'], z['kind'] = table, factors.kinds[r]
    z['next_a'] = z['next_b'] = z['i'] = z['a'] = -1
    z['tested'] = 0
    z['j'] = nodes[r, nodes.shape[1] - 1]
    if table in (EDGES, SIGHTINGS):
        z['i'] = nodes[r, 0]
        z['a'] = state.of_pose[z['i']]
    on_landmark = table in (SIGHTINGS, LANDMARK_PRIORS)
    z['b'] = state.of_landmark[z['j']] if on_landmark else state.of_pose[z['j']]
    x, y = measured[r, 0], measured[r, 1]
    z['c'], z['s'], z['x'], z['y'], z['theta'] = 1.0, 0.0, x, y, 0.0
    z['I00'], z['I01'], z['I11'] = info[r, 0, 0], info[r, 0, 1], info[r, 1, 1]
    z['I02'] = z['I12'] = z['I22'] = 0.0
    if not on_landmark:
        z['I02'], z['I12'], z['I22'] = info[r, 0, 2], info[r, 1, 2], info[r, 2, 2]
        z['theta'] = measured[r, 2]
    if table == EDGES:
        c, s = math.cos(z['theta']), math.sin(z['theta'])
        z['c'], z['s'] = c, s
        z['x'], z['y'] = rotate_back(c, s, x, y)


@part
def _set_enabled(state: State, f: int, on: bool) -> None:
    """Enable or disable a factor."""
    z = state.factors[f]
    for end in range(2):
        v = z['a'] if end == 0 else z['b']
        if v < 0:
            continue
        u = state.unknowns[v]
        if on:
            _link(state, v, 2 * f + end)
            u['links'] += 1
        else:
            _unlink(state, v, 2 * f + end)
            u['links'] -= 1
        sign = 1.0 if on else -1.0
        info = z['I00'] + z['I11']
        arm = z['x'] * z['x'] + z['y'] * z['y'] if end == 0 else 0.0
        u['position_info'] += sign * info
        u['heading_info'] += sign * (z['I22'] + arm * info)
        u['last_change'] = state.counts[STEP]
        mark_affected(state, v)


@part
def _link(state: State, v: int, link: int) -> None:
    """Put a factor's end into the chain of unknown v."""
    z, u = state.factors[link // 2], state.unknowns[v]
    before, after = -1, u['head']
    if u['size'] == 3 and link % 2 == 1:
        while after >= 0 and after % 2 == 0:
            before, after = after, _next(state, after)
    if u['size'] == 2 and z['a'] >= 0:
        while after >= 0 and state.factors[after // 2]['a'] < 0:
            before, after = after, _next(state, after)
    _set_next(state, link, after)
    if before < 0:
        u['head'] = link
    else:
        _set_next(state, before, link)


@part
def _unlink(state: State, v: int, link: int) -> None:
    """Take a factor's end out of the chain of unknown v."""
    after = _next(state, link)
    k = state.unknowns[v]['head']
    if k == link:
        state.unknowns[v]['head'] = after
        return
    while _next(state, k) != link:
        k = _next(state, k)
    _set_next(state, k, after)


@part
def _next(state: State, link: int) -> int:
    z = state.factors[link // 2]
    after: int = z['next_a'] if link % 2 == 0 else z['next_b']
    return after


@part
def _set_next(state: State, link: int, after: int) -> None:
    z = state.factors[link // 2]
    if link % 2 == 0:
        z['next_a'] = after
    else:
        z['next_b'] = after


@part
def linearize_factor(state: State, f: int, problem: Problem) -> tuple[float, float, float]:
    """Linearize a factor at the current estimate; its residual e - J d, where all d are zero."""
    z, unknowns = state.factors[f], state.unknowns
    poses, landmarks, losses = problem.poses, problem.landmarks, problem.losses
    i, j, a, b, kind = z['i'], z['j'], z['a'], z['b'], z['kind']
    on_landmark = z['table'] in (SIGHTINGS, LANDMARK_PRIORS)
    dx, dy = (landmarks[j, 0], landmarks[j, 1]) if on_landmark else (poses[j, 0], poses[j, 1])
    c, s, theta = z['c'], z['s'], 0.0
    if i >= 0:
        theta = poses[i, 2]
        c, s = rotate(c, s, math.cos(theta), math.sin(theta))
        dx -= poses[i, 0]
        dy -= poses[i, 1]
    c, s = axes(kind, c, s, dx, dy)
    e0, e1 = residual(c, s, dx, dy, z['x'], z['y'])
    e2 = 0.0 if on_landmark else wrapped_by_turns(poses[j, 2] - theta - z['theta'])
    z['C'], z['S'], z['dx'], z['dy'] = c, s, dx, dy
    z['from'] = unknowns[a]['theta'] + unknowns[a]['dtheta'] if a >= 0 else theta
    z['valid_turn'] = valid_turn(z, problem.robust, problem.thresholds)
    if a >= 0:
        restrict_validity(unknowns[a], z)
    if b >= 0 and is_curved(kind):
        restrict_validity(unknowns[b], z)
    z['weight'] = loss(losses[kind, 0], losses[kind, 1], squared(z, e0, e1, e2))[1]
    step_i = step_j = (0.0, 0.0, 0.0)
    if a >= 0:
        step_i = unknowns[a]['dx'], unknowns[a]['dy'], unknowns[a]['dtheta']
    if b >= 0:
        step_j = unknowns[b]['dx'], unknowns[b]['dy'], unknowns[b]['dtheta']
    l0, l1, l2 = linear_change(c, s, (dx, dy), step_i, step_j)
    return e0 - l0, e1 - l1, 0.0 if on_landmark else e2 - l2
