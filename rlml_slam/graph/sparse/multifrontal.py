# SPDX-License-Identifier: Apache-2.0
"""Multifrontal block Cholesky factorization H = L L^T, and the solves with L.

Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", ACM
TOMS 9 (1983); Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34 (1992);
Davis, "Direct Methods for Sparse Linear Systems", SIAM (2006), chapter 4.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.sparse.dense_fronts import partial_cholesky, schur_update
from rlml_slam.graph.sparse.symbolic_analysis import ENTRY, FRONT, Ints, Records, Structure
from rlml_slam.se2 import Array

# a pivot below this share of its diagonal is rounding: the matrix is singular
SINGULAR = 1e-14


@part
def layout_fronts(structure: Structure, dims: Ints) -> tuple[Records, Records, Ints]:
    """(fronts, entries, sizes of the two stacks) for ``dims`` (n,) rows per variable.

    A stack holds the update matrices of finished subtrees, those of children and of parents on
    different sides: so a front is assembled from one side while it grows on the other.
    """
    order, old_fronts, old_entries = structure.order, structure.fronts, structure.entries
    n, num = len(order), len(old_fronts) - 1
    offset = np.empty(n + 1, np.int64)
    offset[0] = 0
    for k in range(n):
        offset[k + 1] = offset[k] + dims[order[k]]
    fronts = np.empty(num + 1, FRONT)
    entries = np.empty(len(old_entries), ENTRY)
    pending = np.empty((2, num + 1), np.int64)
    count, top, most = np.zeros(2, np.int64), np.zeros(2, np.int64), np.zeros(2, np.int64)
    panel = 0
    for s in range(num + 1):
        first, start = old_fronts[s]['first'], old_fronts[s]['start']
        side = old_fronts[s]['side']
        fronts[s]['first'], fronts[s]['start'], fronts[s]['side'] = first, start, side
        fronts[s]['parent'] = old_fronts[s]['parent']
        fronts[s]['panel'] = panel
        fronts[s]['width'] = fronts[s]['height'] = 0
        if s == num:
            break
        row = 0
        for p in range(start, old_fronts[s + 1]['start']):
            k = old_entries[p]['position']
            entries[p]['position'] = k
            entries[p]['above'] = old_entries[p]['above']
            entries[p]['local'] = row
            entries[p]['scalar'] = offset[k]
            row += offset[k + 1] - offset[k]
        width = offset[old_fronts[s + 1]['first']] - offset[first]
        fronts[s]['width'] = width
        fronts[s]['height'] = row
        panel += width * row
        top[side] += (row - width) * (row - width)
        most[side] = max(most[side], top[side])
        pending[side, count[side]] = s
        count[side] += 1
        side = 1 - side
        while count[side] > 0 and fronts[pending[side, count[side] - 1]]['parent'] == s:
            count[side] -= 1
            c = pending[side, count[side]]
            below = fronts[c]['height'] - fronts[c]['width']
            top[side] -= below * below
    return fronts, entries, most


@part
def reuse_or_allocate(memory: Array, size: int) -> Array:
    """The first ``size`` numbers of ``memory``, or newly allocated ones where it is too small."""
    return memory[:size] if size <= len(memory) else np.empty(size)


@part
def max_height(fronts: Records) -> int:
    """Rows of the largest front."""
    rows = 0
    for s in range(len(fronts)):
        rows = max(rows, fronts[s]['height'])
    return rows


@kernel
def factorise(
    fronts: Records, entries: Records, values: Array, left: Array, right: Array, x: Array
) -> int:
    """Cholesky factor in place of the matrix in ``values``; -1, or the supernode that failed.

    ``left`` and ``right`` are memory of the sizes that layout_fronts returns. ``x`` becomes L^-1 x
    on the way, front by front.
    """
    num = len(fronts) - 1
    pending = np.empty((2, num + 1), np.int64)
    base = np.empty((2, num + 1), np.int64)
    count, top = np.zeros(2, np.int64), np.zeros(2, np.int64)
    most = max_height(fronts)
    floor, work = np.empty(most), np.empty(most)
    runs = np.empty((2, most + 1), np.int64)
    for s in range(num):
        width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
        size = height - width
        for j in range(width):
            floor[j] = SINGULAR * values[at + j * (height + 1)]
        side = fronts[s]['side']
        mine, theirs = (left, right) if side == 0 else (right, left)
        other, u = 1 - side, top[side]
        child = count[other] - 1
        while child >= 0 and fronts[pending[other, child]]['parent'] == s:
            num_runs = _runs(fronts, entries, pending[other, child], s, runs)
            _extend_panel(theirs, base[other, child], runs, num_runs, values, at, width, height)
            child -= 1
        if not partial_cholesky(values, at, width, height, floor):
            return s
        lower_step(fronts, entries, values, s, x, work)
        schur_update(values, at, width, height, mine, u)
        for c in range(count[other] - 1, child, -1):
            num_runs = _runs(fronts, entries, pending[other, c], s, runs)
            _extend_below(theirs, base[other, c], runs, num_runs, mine, u, width, size)
            top[other] = base[other, c]
        count[other] = child + 1
        pending[side, count[side]] = s
        base[side, count[side]] = u
        count[side] += 1
        top[side] = u + size * size
    return -1


@part
def _runs(fronts: Records, entries: Records, c: int, s: int, runs: Ints) -> int:
    """Rows below the pivots of front c that stay together in its parent s: number of runs.

    Run r takes rows runs[0, r]:runs[0, r + 1] of the update matrix to row runs[1, r] of s.
    """
    begin, end = fronts[c]['start'], fronts[c + 1]['start']
    width, start = fronts[c]['width'], fronts[s]['start']
    num, next_to = 0, -1
    for p in range(begin + fronts[c + 1]['first'] - fronts[c]['first'], end):
        to = entries[start + entries[p]['above']]['local']
        local = entries[p]['local']
        if to != next_to:
            runs[0, num] = local - width
            runs[1, num] = to
            num += 1
        after = entries[p + 1]['local'] if p + 1 < end else fronts[c]['height']
        next_to = to + after - local
    runs[0, num] = fronts[c]['height'] - width
    return num


@part
def _extend_panel(
    stack: Array, c: int, runs: Ints, num: int, values: Array, at: int, width: int, height: int
) -> None:
    """Add the columns of a child's update matrix that are pivots here to the panel."""
    size = runs[0, num]
    for r in range(num):
        if runs[1, r] >= width:
            break
        last = min(runs[0, r + 1], runs[0, r] + width - runs[1, r])
        for i in range(runs[0, r], last):
            column = at + (runs[1, r] + i - runs[0, r]) * height
            for q in range(r, num):
                a = i if q == r else runs[0, q]
                b = column + runs[1, q] + a - runs[0, q]
                for k in range(runs[0, q + 1] - a):
                    values[b + k] += stack[c + i * size + a + k]


@part
def _extend_below(
    stack: Array, c: int, runs: Ints, num: int, target: Array, u: int, width: int, below: int
) -> None:
    """Add the other columns of a child's update matrix to the update matrix here."""
    size = runs[0, num]
    for r in range(num):
        first = max(runs[0, r], runs[0, r] + width - runs[1, r])
        for i in range(first, runs[0, r + 1]):
            column = u + (runs[1, r] + i - runs[0, r] - width) * below - width
            for q in range(r, num):
                a = i if q == r else runs[0, q]
                b = column + runs[1, q] + a - runs[0, q]
                for k in range(runs[0, q + 1] - a):
                    target[b + k] += stack[c + i * size + a + k]


@part
def solve_lower(fronts: Records, entries: Records, values: Array, x: Array) -> None:
    """Forward substitution: x becomes L^-1 x, in the order of elimination."""
    work = np.empty(max_height(fronts))
    for s in range(len(fronts) - 1):
        lower_step(fronts, entries, values, s, x, work)


@part
def lower_step(
    fronts: Records, entries: Records, values: Array, s: int, x: Array, work: Array
) -> None:
    """Front s's part in the forward solve."""
    width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
    start, end = fronts[s]['start'], fronts[s + 1]['start']
    own = entries[start]['scalar']
    for j in range(width):
        work[j] = x[own + j]
    for i in range(width, height):
        work[i] = 0.0
    for j in range(width):
        a = at + j * height
        y = work[j] / values[a + j]
        x[own + j] = y
        L0 = values[a + j + 1 : a + height]
        w = work[j + 1 : height]
        for i in range(height - j - 1):
            w[i] -= y * L0[i]
    for p in range(start + fronts[s + 1]['first'] - fronts[s]['first'], end):
        k, i = entries[p]['scalar'], entries[p]['local']
        after = entries[p + 1]['local'] if p + 1 < end else height
        for r in range(after - i):
            x[k + r] += work[i + r]


@part
def solve_upper(fronts: Records, entries: Records, values: Array, x: Array) -> None:
    """Back-substitution: x becomes L^-T x, in the order of elimination."""
    work = np.empty(max_height(fronts))
    for s in range(len(fronts) - 2, -1, -1):
        width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
        start, end = fronts[s]['start'], fronts[s + 1]['start']
        own = entries[start]['scalar']
        for p in range(start + fronts[s + 1]['first'] - fronts[s]['first'], end):
            k, i = entries[p]['scalar'], entries[p]['local']
            after = entries[p + 1]['local'] if p + 1 < end else height
            for r in range(after - i):
                work[i + r] = x[k + r]
        for j in range(width - 1, -1, -1):
            a = at + j * height
            # four partial sums: a chain of additions would wait for each one
            t0, t1, t2, t3 = x[own + j], 0.0, 0.0, 0.0
            i = j + 1
            while i + 3 < height:
                t0 -= values[a + i] * work[i]
                t1 -= values[a + i + 1] * work[i + 1]
                t2 -= values[a + i + 2] * work[i + 2]
                t3 -= values[a + i + 3] * work[i + 3]
                i += 4
            while i < height:
                t0 -= values[a + i] * work[i]
                i += 1
            y = ((t0 + t1) + (t2 + t3)) / values[a + j]
            work[j] = y
            x[own + j] = y
