# SPDX-License-Identifier: Apache-2.0
"""Numeric factorisation of a part of the tree: assemble, take up the children, eliminate.

The right-hand side is the last row of every front, so the forward solve comes with the factor.

Of an update matrix of k rows and k - 1 columns the lower triangle is kept: four columns at a time,
as dense.rank_update takes them, each four from the row of their first one on.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import fetch, part
from rlml_slam.graph.incremental.affected_subtree import Part
from rlml_slam.graph.incremental.relinearization import linearize_factor
from rlml_slam.graph.incremental.solver_state import (
    FACTOR_BYTES,
    IN_USE,
    LINE,
    STEP,
    TOP,
    State,
    hang,
    room_of,
    take_block,
    take_clique,
    with_room,
)
from rlml_slam.graph.sparse.dense_fronts import partial_cholesky, rank_update
from rlml_slam.graph.sparse.multifrontal import SINGULAR, highest
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array


@part
def reserve(state: State, pool: Array, anew: Part) -> Array:
    """The pool with room for all new cliques that do not fit into free blocks."""
    numbers, need = pool.view(np.int64), 0
    free = state.free.copy()
    for s in range(len(anew.fronts) - 1):
        width, height = anew.fronts[s]['width'], anew.fronts[s]['height']
        entries = anew.fronts[s + 1]['start'] - anew.fronts[s]['start']
        room, elements = room_of(_size(width, height, entries))
        if free[room] >= 0:
            free[room] = numbers[free[room]]
        else:
            need += elements
    return with_room(pool, state.counts[TOP], need)


@part
def _size(width: int, height: int, members: int) -> int:
    below = height + 1 - width
    return width * (height + 1) + _triangle(below) + members


@part
def _triangle(below: int) -> int:
    """Elements of an update matrix of so many rows, of which the last one is no column."""
    full = (below - 1) // 4
    return _column(below, 4 * full) + 4 * full + (below - 1 - 4 * full) * (below - 4 * full)


@part
def _column(below: int, j: int) -> int:
    """Where row 0 of its column j would be: the rows above the first of its four are not kept."""
    first = j - j % 4
    return first * below - first * (first - 4) // 2 + j % 4 * (below - first) - first


@part
def make_cliques(state: State, numbers: Ints, anew: Part) -> Ints:
    """Records and blocks of the new cliques, linked; the clique of each front, or -1."""
    fronts, entries, order = anew.fronts, anew.entries, anew.order
    m, num = len(anew.unknowns), len(fronts) - 1
    of_front = np.empty(num, np.int64)
    for s in range(num - 1, -1, -1):
        of_front[s] = -1
        start, end = fronts[s]['start'], fronts[s + 1]['start']
        own = fronts[s + 1]['first'] - fronts[s]['first']
        width, height = fronts[s]['width'], fronts[s]['height']
        if width == 0:
            continue
        c = of_front[s] = take_clique(state.cliques, state.counts)
        clique = state.cliques[c]
        room, elements = room_of(_size(width, height, end - start))
        clique['room'], clique['width'], clique['height'] = room, width, height
        clique['block'] = take_block(state.free, state.counts, numbers, room, elements)
        state.counts[IN_USE] += elements
        clique['child'], clique['mark'] = -1, state.counts[STEP]
        parent = fronts[s]['parent'] if height > width else -1
        hang(state.cliques, c, of_front[parent] if parent >= 0 else -1)
        w = first = clique['block']
        for p in range(start, end):
            n = order[entries[p]['position']]
            if n < m:
                numbers[w] = anew.unknowns[n]
                w += 1
                if p < start + own:
                    clique['own'] = w - first
                    state.unknowns[anew.unknowns[n]]['clique'] = c
            elif n > m and p < start + own:
                hang(state.cliques, anew.cliques[n - m - 1], c)
        clique['members'] = w - first
    return of_front


@part
def refactor(
    state: State, pool: Array, numbers: Ints, anew: Part, of_front: Ints,
    losses: Array, poses: Array, landmarks: Array, due: float, turn: float,
) -> tuple[int, int]:  # fmt: skip
    """Factor the new cliques: (unknown where that is impossible or -1, factors assembled)."""
    fronts, entries = anew.fronts, anew.entries
    most = highest(fronts) + 1
    row_of = np.empty(len(anew.position), np.int64)
    column = np.empty(most, np.int64)
    rows = np.empty(most, np.int64)
    floor = np.empty(most)
    first = _by_elimination(state, anew)
    assembled = 0
    for s in range(len(fronts) - 1):
        c = of_front[s]
        if c < 0:
            continue
        clique = state.cliques[c]
        at = clique['block'] + clique['members']
        width, height = clique['width'], clique['height']
        tall, below = height + 1, height + 1 - width
        update = at + width * tall
        for j in range(height):
            column[j] = at + j * tall
            if j >= width:
                column[j] = update + _column(below, j - width) - width
        for k in range(at, update + _triangle(below)):
            pool[k] = 0.0
        for p in range(fronts[s]['start'], fronts[s + 1]['start']):
            row_of[anew.order[entries[p]['position']]] = entries[p]['local']
        for k in range(fronts[s]['first'], fronts[s + 1]['first']):
            n = anew.order[k]
            if n < len(anew.unknowns):
                assembled += _assemble(
                    state, pool, first[n], row_of, column, height, losses, poses, landmarks,
                    due, turn,
                )  # fmt: skip
        child = clique['child']
        while child >= 0:
            _extend(state, pool, numbers, child, row_of, column, height, rows)
            child = state.cliques[child]['next']
        for j in range(width):
            floor[j] = SINGULAR * pool[at + j * (tall + 1)]
        if not partial_cholesky(pool, at, width, tall, floor):
            return numbers[clique['block']], assembled
        for j in range(0, below - 1, 4):
            rank_update(
                pool, update + _column(below, j) + j, below - j, min(4, below - 1 - j),
                pool, at + width + j, tall, width, below - j,
            )  # fmt: skip
    return -1, assembled


@part
def _by_elimination(state: State, anew: Part) -> Ints:
    """First factor (m,) of those of which each unknown of the part is eliminated first, or -1.

    The chains of the poses have all factors of the part but those on a landmark alone: that of a
    landmark, which may have been seen from all over the map, is left where these end.
    """
    unknowns, position = state.unknowns, anew.position
    out = np.empty(len(anew.unknowns), np.int64)
    for n in range(len(out)):
        out[n] = -1
    for n in range(len(out)):
        u = unknowns[anew.unknowns[n]]
        link = u['head']
        while link >= 0:
            f, end = link // 2, link % 2
            z = state.factors[f]
            if u['size'] == 2 and z['a'] >= 0:
                break
            link = z['next_a'] if end == 0 else z['next_b']
            fetch(state.factors, link // 2, 0)
            first = n
            if end == 0 and z['b'] >= 0:
                m = unknowns[z['b']]['local']
                if m < 0:
                    continue
                first = m if position[m] < position[n] else n
            elif end == 1 and z['a'] >= 0:
                continue
            z['after'] = out[first]
            out[first] = f
    return out


@part
def _assemble(
    state: State, pool: Array, f: int, row_of: Ints, column: Ints, height: int,
    losses: Array, poses: Array, landmarks: Array, due: float, turn: float,
) -> int:  # fmt: skip
    """Add the chain of factors from f on; how many."""
    unknowns, num = state.unknowns, 0
    while f >= 0:
        z = state.factors[f]
        for k in range(0, FACTOR_BYTES, LINE):
            fetch(state.factors, z['after'], k)
        e = linearize_factor(state, f, losses, poses, landmarks, due, turn)
        a, b, size = -1, -1, 3
        if z['a'] >= 0:
            a = row_of[unknowns[z['a']]['local']]
        if z['b'] >= 0:
            b, size = row_of[unknowns[z['b']]['local']], unknowns[z['b']]['size']
        _add_factor(z, e, pool, column, height, a, b, size)
        num += 1
        f = z['after']
    return num


@part
def _add_factor(
    z: np.void, e: tuple[float, float, float], v: Array, column: Ints, height: int, a: int, b: int,
    size: int,
) -> None:  # fmt: skip
    """Add a factor at rows a and b (-1: none) of a front, with the formulas of linearize.py."""
    c, s, dx, dy, w = z['C'], z['S'], z['dx'], z['dy'], z['weight']
    I00, I01, I02 = w * z['I00'], w * z['I01'], w * z['I02']
    I11, I12, I22 = w * z['I11'], w * z['I12'], w * z['I22']
    e0, e1, e2 = e
    q0 = I00 * e0 + I01 * e1 + I02 * e2
    q1 = I01 * e0 + I11 * e1 + I12 * e2
    u0, u1, u2 = c * q0 - s * q1, s * q0 + c * q1, I02 * e0 + I12 * e1 + I22 * e2
    t00, t01 = I00 * c - I01 * s, I00 * s + I01 * c
    t10, t11 = I01 * c - I11 * s, I01 * s + I11 * c
    M00, M01, M11 = c * t00 - s * t10, c * t01 - s * t11, s * t01 + c * t11
    M02, M12, M22 = c * I02 - s * I12, s * I02 + c * I12, I22
    n0 = dx * M01 - dy * M00 + M02
    n1 = dx * M11 - dy * M01 + M12
    n2 = dx * M12 - dy * M02 + M22
    if a >= 0:
        k, k1, k2 = column[a] + a, column[a + 1] + a, column[a + 2] + a
        v[k] += M00
        v[k + 1] += M01
        v[k + 2] += n0
        v[k1 + 1] += M11
        v[k1 + 2] += n1
        v[k2 + 2] += dx * n1 - dy * n0 + n2
        r = height - a
        v[k + r] -= u0
        v[k1 + r] -= u1
        v[k2 + r] -= dx * u1 - dy * u0 + u2
    if b >= 0:
        k, k1 = column[b] + b, column[b + 1] + b
        r = height - b
        v[k] += M00
        v[k + 1] += M01
        v[k1 + 1] += M11
        v[k + r] += u0
        v[k1 + r] += u1
        if size == 3:
            k2 = column[b + 2] + b
            v[k + 2] += M02
            v[k1 + 2] += M12
            v[k2 + 2] += M22
            v[k2 + r] += u2
    if a < 0 or b < 0:
        return
    if a < b:  # H_ba = -M A
        k, k1, k2 = column[a] + b, column[a + 1] + b, column[a + 2] + b
        v[k] -= M00
        v[k + 1] -= M01
        v[k1] -= M01
        v[k1 + 1] -= M11
        v[k2] -= n0
        v[k2 + 1] -= n1
        if size == 3:
            v[k + 2] -= M02
            v[k1 + 2] -= M12
            v[k2 + 2] -= n2
    else:  # H_ab = -A^T M
        k, k1 = column[b] + a, column[b + 1] + a
        v[k] -= M00
        v[k + 1] -= M01
        v[k + 2] -= n0
        v[k1] -= M01
        v[k1 + 1] -= M11
        v[k1 + 2] -= n1
        if size == 3:
            k2 = column[b + 2] + a
            v[k2] -= M02
            v[k2 + 1] -= M12
            v[k2 + 2] -= n2


@part
def _extend(
    state: State, pool: Array, numbers: Ints, c: int, row_of: Ints, column: Ints, height: int,
    rows: Ints,
) -> None:  # fmt: skip
    """Add the update matrix of clique c to the front of its parent.

    A clique that was there before may have its rows in another order than its new parent.
    """
    clique = state.cliques[c]
    first = clique['block']
    w, ascending = 0, True
    for p in range(first + clique['own'], first + clique['members']):
        u = state.unknowns[numbers[p]]
        row = row_of[u['local']]
        ascending = ascending and (w == 0 or row > rows[w - 1])
        for r in range(u['size']):
            rows[w] = row + r
            w += 1
    rows[w] = height
    below = w + 1
    panel = first + clique['members']
    update = panel + clique['width'] * (clique['height'] + 1)
    for k in range(update, update + _triangle(below), 8):
        fetch(pool, k, 0)
    for j in range(w):
        source = update + _column(below, j)
        t = rows[j]
        to = column[t]
        if ascending:
            for i in range(j, below):
                pool[to + rows[i]] += pool[source + i]
        else:
            for i in range(j, below):
                if rows[i] >= t:
                    pool[to + rows[i]] += pool[source + i]
                else:
                    pool[column[rows[i]] + t] += pool[source + i]
