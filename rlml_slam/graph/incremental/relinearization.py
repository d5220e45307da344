# SPDX-License-Identifier: Apache-2.0
"""Factors of the incremental solver: taken from the graph, and linearised.

The coordinates are the raw ones of factors.py, so a factor's linear model stays a function of the
estimate itself and each factor has a linearisation point of its own.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.graph.incremental.relinearization_test import (
    calm,
    narrow,
    squared,
)
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
    State,
    ask,
    take_factor,
    take_unknown,
)
from rlml_slam.graph.model.linearization import wrapped
from rlml_slam.graph.model.packed_system import Factors, Flags, Tables
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.se2 import Array


@part
def take(state: State, tables: Tables, poses: Array, landmarks: Array) -> None:
    """Take over what is new in the graph: nodes, factors, factors switched on or off."""
    count = state.counts
    for i in range(count[POSES], len(poses)):
        state.of_pose[i] = -1
        state.on[FIXED_POSES, i] = tables.fixed_poses[i]
        if not tables.fixed_poses[i]:
            state.of_pose[i] = _new_unknown(state, 3, i)
            _refer(state, state.of_pose[i], poses[i, 0], poses[i, 1], poses[i, 2])
    count[POSES] = len(poses)
    for i in range(count[LANDMARKS], len(landmarks)):
        state.of_landmark[i] = -1
        state.on[FIXED_LANDMARKS, i] = tables.fixed_landmarks[i]
        if not tables.fixed_landmarks[i]:
            state.of_landmark[i] = _new_unknown(state, 2, i)
            _refer(state, state.of_landmark[i], landmarks[i, 0], landmarks[i, 1], 0.0)
    count[LANDMARKS] = len(landmarks)
    _take_factors(state, EDGES, tables.edges)
    _take_factors(state, SIGHTINGS, tables.sightings)
    _take_factors(state, POSE_PRIORS, tables.pose_priors)
    _take_factors(state, LANDMARK_PRIORS, tables.landmark_priors)


@part
def _new_unknown(state: State, size: int, index: int) -> int:
    v = take_unknown(state.unknowns, state.counts)
    u = state.unknowns[v]
    u['size'], u['index'] = size, index
    u['clique'] = u['head'] = u['local'] = -1
    u['links'] = 0
    u['seeded'] = u['late'] = u['moved'] = 0
    u['stiff'] = u['turn'] = 0.0
    return v


@part
def _refer(state: State, v: int, x: float, y: float, theta: float) -> None:
    """Measure d from this estimate on."""
    u = state.unknowns[v]
    u['x'], u['y'], u['theta'] = x, y, theta
    u['low'], u['high'] = -np.inf, np.inf
    u['dx'] = u['dy'] = u['dtheta'] = u['sx'] = u['sy'] = u['stheta'] = 0.0


@part
def refer_all(state: State, poses: Array, landmarks: Array) -> None:
    """Measure all d from the estimate at hand."""
    for v in range(state.counts[UNKNOWNS]):
        i = state.unknowns[v]['index']
        if state.unknowns[v]['size'] == 3:
            _refer(state, v, poses[i, 0], poses[i, 1], poses[i, 2])
        else:
            _refer(state, v, landmarks[i, 0], landmarks[i, 1], 0.0)


@part
def _take_factors(state: State, table: int, factors: Factors) -> None:
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
                    _switch(state, state.of_row[table, r], on[r])
    for r in range(known, rows):
        f = take_factor(state.factors, state.counts)
        state.of_row[table, r] = f
        _copy(state, f, table, factors, r)
        on[r] = factors.enabled[r]
        if on[r]:
            _switch(state, f, True)
    state.counts[ROWS + table] = rows


@part
def differ(a: Flags, b: Flags, start: int, end: int) -> bool:
    """Whether flags between two places are not the same."""
    different = False
    for r in range(start, end):
        different |= a[r] != b[r]
    return different


@part
def _copy(state: State, f: int, table: int, factors: Factors, r: int) -> None:
    """Row r of a table into record f."""
    z, nodes = state.factors[f], factors.nodes
    measured, info = factors.measured, factors.information
    z['table'], z['kind'] = table, factors.kinds[r]
    z['next_a'] = z['next_b'] = z['i'] = z['a'] = -1
    z['checked'] = 0
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
        z['c'], z['s'], z['x'], z['y'] = c, s, c * x + s * y, c * y - s * x


@part
def _switch(state: State, f: int, on: bool) -> None:
    """Let a factor take part, or no longer."""
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
        stiff = z['I00'] + z['I11']
        arm = z['x'] * z['x'] + z['y'] * z['y'] if end == 0 else 0.0
        u['stiff'] += sign * stiff
        u['turn'] += sign * (z['I22'] + arm * stiff)
        u['late'] = state.counts[STEP]
        ask(state, v)


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
def linearize_factor(
    state: State, f: int, losses: Array, poses: Array, landmarks: Array, due: float, turn: float
) -> tuple[float, float, float]:
    """Linearise a factor at the estimate at hand; its residual where all d are zero."""
    z, unknowns = state.factors[f], state.unknowns
    i, j, a, b = z['i'], z['j'], z['a'], z['b']
    on_landmark = z['table'] in (SIGHTINGS, LANDMARK_PRIORS)
    dx, dy = (landmarks[j, 0], landmarks[j, 1]) if on_landmark else (poses[j, 0], poses[j, 1])
    c, s, theta = z['c'], z['s'], 0.0
    if i >= 0:
        theta = poses[i, 2]
        cos, sin = math.cos(theta), math.sin(theta)
        c, s = cos * z['c'] - sin * z['s'], sin * z['c'] + cos * z['s']
        dx -= poses[i, 0]
        dy -= poses[i, 1]
    e0, e1 = c * dx + s * dy - z['x'], c * dy - s * dx - z['y']
    e2 = 0.0 if on_landmark else wrapped(poses[j, 2] - theta - z['theta'])
    z['C'], z['S'], z['dx'], z['dy'] = c, s, dx, dy
    z['from'] = unknowns[a]['theta'] + unknowns[a]['dtheta'] if a >= 0 else theta
    z['calm'] = calm(z, losses, due, turn)
    if a >= 0:
        narrow(unknowns[a], z)
    z['weight'] = loss(losses[z['kind'], 0], losses[z['kind'], 1], squared(z, e0, e1, e2))[1]
    # e + J d is linear, so where all d are zero it is e - J d
    x = y = t = 0.0
    if b >= 0:
        x, y, t = unknowns[b]['dx'], unknowns[b]['dy'], unknowns[b]['dtheta']
    if a >= 0:
        t_a = unknowns[a]['dtheta']
        x -= unknowns[a]['dx'] - dy * t_a
        y -= unknowns[a]['dy'] + dx * t_a
        t -= t_a
    return e0 - (c * x + s * y), e1 - (c * y - s * x), 0.0 if on_landmark else e2 - t
