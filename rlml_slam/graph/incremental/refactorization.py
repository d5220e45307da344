# SPDX-License-Identifier: Apache-2.0
"""Numeric factorization of the affected part: assemble, extend-add the children, eliminate.

The right-hand side is the last row of every front, so the forward solve comes with the factor.

Of an update matrix of k rows and k - 1 columns the lower triangle is kept: four columns at a time,
as dense_fronts.rank_update takes them, each four from the row of their first one on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import fetch, part
from rlml_slam.graph.incremental.affected_subtree import AffectedPart
from rlml_slam.graph.incremental.relinearization import linearize_factor
from rlml_slam.graph.incremental.solver_state import (
    FACTOR_BYTES,
    IN_USE,
    LINE,
    STEP,
    TOP,
    Problem,
    State,
    allocate_block,
    allocate_clique,
    attach_clique,
    ensure_capacity,
    size_class_of,
)
from rlml_slam.graph.model.factors import (
    Information,
    moment,
    position_information,
    rotate,
    weighted,
)
from rlml_slam.graph.sparse.dense_fronts import partial_cholesky, rank_update
from rlml_slam.graph.sparse.multifrontal import SINGULAR, max_height
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array


@part
def reserve(state: State, pool: Array, affected: AffectedPart) -> Array:
    """The pool with capacity for all new cliques that do not fit into free blocks."""
    numbers, need = pool.view(np.int64), 0
    free = state.free.copy()
    for s in range(len(affected.fronts) - 1):
        width, height = affected.fronts[s]['width'], affected.fronts[s]['height']
        entries = affected.fronts[s + 1]['start'] - affected.fronts[s]['start']
        size_class, elements = size_class_of(_size(width, height, entries))
        if free[size_class] >= 0:
            free[size_class] = numbers[free[size_class]]
        else:
            need += elements
    return ensure_capacity(pool, state.counts[TOP], need)


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
def make_cliques(state: State, numbers: Ints, affected: AffectedPart) -> Ints:
    """Records and blocks of the new cliques, linked; the clique of each front, or -1."""
    fronts, entries, order = affected.fronts, affected.entries, affected.order
    m, num = len(affected.unknowns), len(fronts) - 1
    of_front = np.empty(num, np.int64)
    for s in range(num - 1, -1, -1):
        of_front[s] = -1
        start, end = fronts[s]['start'], fronts[s + 1]['start']
        own = fronts[s + 1]['first'] - fronts[s]['first']
        width, height = fronts[s]['width'], fronts[s]['height']
        if width == 0:
            continue
        c = of_front[s] = allocate_clique(state.cliques, state.counts)
        clique = state.cliques[c]
        size_class, elements = size_class_of(_size(width, height, end - start))
        clique['size_class'], clique['width'], clique['height'] = size_class, width, height
        clique['block'] = allocate_block(state.free, state.counts, numbers, size_class, elements)
        state.counts[IN_USE] += elements
        clique['child'], clique['mark'] = -1, state.counts[STEP]
        parent = fronts[s]['parent'] if height > width else -1
        attach_clique(state.cliques, c, of_front[parent] if parent >= 0 else -1)
        w = first = clique['block']
        for p in range(start, end):
            n = order[entries[p]['position']]
            if n < m:
                numbers[w] = affected.unknowns[n]
                w += 1
                if p < start + own:
                    clique['own'] = w - first
                    state.unknowns[affected.unknowns[n]]['clique'] = c
            elif n > m and p < start + own:
                attach_clique(state.cliques, affected.cliques[n - m - 1], c)
        clique['members'] = w - first
    return of_front


class Front(NamedTuple):
    """Rows and columns of the front that is assembled.

    ``row_of`` (n,) the first row of each node of the part, ``column`` (h,) where row 0 of each
    column would be in the pool, ``rows`` memory for the rows of a child.
    """

    row_of: Ints
    column: Ints
    rows: Ints


@part
def refactor(
    state: State, pool: Array, numbers: Ints, affected: AffectedPart, of_front: Ints,
    problem: Problem,
) -> tuple[int, int]:  # fmt: skip
    """Factor the new cliques: (unknown where that is impossible or -1, factors assembled)."""
    fronts, entries = affected.fronts, affected.entries
    most = max_height(fronts) + 1
    front = Front(
        np.empty(len(affected.position), np.int64), np.empty(most, np.int64),
        np.empty(most, np.int64),
    )  # fmt: skip
    floor = np.empty(most)
    first = _by_elimination(state, affected)
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
            front.column[j] = at + j * tall
            if j >= width:
                front.column[j] = update + _column(below, j - width) - width
        for k in range(at, update + _triangle(below)):
            pool[k] = 0.0
        for p in range(fronts[s]['start'], fronts[s + 1]['start']):
            front.row_of[affected.order[entries[p]['position']]] = entries[p]['local']
        for k in range(fronts[s]['first'], fronts[s + 1]['first']):
            n = affected.order[k]
            if n < len(affected.unknowns):
                assembled += _assemble(state, pool, first[n], front, height, problem)
        child = clique['child']
        while child >= 0:
            _extend_add(state, pool, numbers, child, front, height)
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
def _by_elimination(state: State, affected: AffectedPart) -> Ints:
    """First factor (m,) of those of which each unknown of the part is eliminated first, or -1.

    The chains of the poses have all factors of the part but those on a landmark alone: that of a
    landmark, which may have been seen from all over the map, is left where these end.
    """
    unknowns, position = state.unknowns, affected.position
    out = np.empty(len(affected.unknowns), np.int64)
    for n in range(len(out)):
        out[n] = -1
    for n in range(len(out)):
        u = unknowns[affected.unknowns[n]]
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
    state: State, pool: Array, f: int, front: Front, height: int, problem: Problem
) -> int:
    """Add the chain of factors from f on; how many."""
    unknowns, num = state.unknowns, 0
    while f >= 0:
        z = state.factors[f]
        for k in range(0, FACTOR_BYTES, LINE):
            fetch(state.factors, z['after'], k)
        e = linearize_factor(state, f, problem)
        a, b, size = -1, -1, 3
        if z['a'] >= 0:
            a = front.row_of[unknowns[z['a']]['local']]
        if z['b'] >= 0:
            b, size = front.row_of[unknowns[z['b']]['local']], unknowns[z['b']]['size']
        _add_factor(z, e, pool, front.column, height, (a, b, size))
        num += 1
        f = z['after']
    return num


@part
def _add_factor(
    z: np.void, e: tuple[float, float, float], v: Array, column: Ints, height: int,
    rows: tuple[int, int, int],
) -> None:  # fmt: skip
    """Add a factor at rows a and b (-1: none) of a front, with the blocks of linearization.py.

    ``rows`` are a, b and the size of b.
    """
    a, b, size = rows
    c, s, dx, dy, w = z['C'], z['S'], z['dx'], z['dy'], z['weight']
    W = Information(
        w * z['I00'], w * z['I01'], w * z['I02'], w * z['I11'], w * z['I12'], w * z['I22']
    )
    q0, q1, u2 = weighted(W, e[0], e[1], e[2])
    u0, u1 = rotate(c, s, q0, q1)
    M00, M01, M11 = position_information(W, 1.0, c, s)
    M02, M12 = rotate(c, s, W.I02, W.I12)
    M22 = W.I22
    n0 = moment(dx, dy, M00, M01) + M02
    n1 = moment(dx, dy, M01, M11) + M12
    n2 = moment(dx, dy, M02, M12) + M22
    if a >= 0:
        k, k1, k2 = column[a] + a, column[a + 1] + a, column[a + 2] + a
        v[k] += M00
        v[k + 1] += M01
        v[k + 2] += n0
        v[k1 + 1] += M11
        v[k1 + 2] += n1
        v[k2 + 2] += moment(dx, dy, n0, n1) + n2
        r = height - a
        v[k + r] -= u0
        v[k1 + r] -= u1
        v[k2 + r] -= moment(dx, dy, u0, u1) + u2
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
def _extend_add(
    state: State, pool: Array, numbers: Ints, c: int, front: Front, height: int
) -> None:
    """Add the update matrix of clique c to the front of its parent (extend-add).

    A clique that was there before may have its rows in another order than its new parent.
    """
    row_of, column, rows = front.row_of, front.column, front.rows
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
