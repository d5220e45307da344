# SPDX-License-Identifier: Apache-2.0
"""Multifrontal block Cholesky factorisation, solves and the inverse on the sparsity pattern."""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.dense import partial_cholesky, schur_update
from rlml_slam.graph.structure import ENTRY, FRONT, Ints, Records, Structure
from rlml_slam.se2 import Array

# a pivot below this share of its diagonal is rounding: the matrix is singular
SINGULAR = 1e-14


@part
def lay_out(structure: Structure, dims: Ints) -> tuple[Records, Records, int]:
    """(fronts, entries, size of the update stack) for ``dims`` (n,) rows per variable."""
    order, old_fronts, old_entries = structure.order, structure.fronts, structure.entries
    n, num = len(order), len(old_fronts) - 1
    offset = np.empty(n + 1, np.int64)
    offset[0] = 0
    for k in range(n):
        offset[k + 1] = offset[k] + dims[order[k]]
    fronts = np.empty(num + 1, FRONT)
    entries = np.empty(len(old_entries), ENTRY)
    pending = np.empty(num + 1, np.int64)
    depth, top, stack, panel = 0, 0, 0, 0
    for s in range(num + 1):
        first, start = old_fronts[s]['first'], old_fronts[s]['start']
        fronts[s]['first'], fronts[s]['start'] = first, start
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
        # the stack holds the update matrices of finished subtrees
        size = (row - width) * (row - width)
        stack = max(stack, top + size)
        while depth > 0 and fronts[pending[depth - 1]]['parent'] == s:
            depth -= 1
            c = pending[depth]
            below = fronts[c]['height'] - fronts[c]['width']
            top -= below * below
        pending[depth] = s
        depth += 1
        top += size
    return fronts, entries, stack


@part
def highest(fronts: Records) -> int:
    """Rows of the largest front."""
    rows = 0
    for s in range(len(fronts)):
        rows = max(rows, fronts[s]['height'])
    return rows


@kernel
def factorise(fronts: Records, entries: Records, values: Array, stack: Array) -> int:
    """Cholesky factor in place of the matrix in ``values``; -1, or the supernode that failed."""
    num = len(fronts) - 1
    pending = np.empty(num + 1, np.int64)
    base = np.empty(num + 1, np.int64)
    most = highest(fronts)
    floor = np.empty(most)
    run_from = np.empty(most + 1, np.int64)
    run_to = np.empty(most + 1, np.int64)
    depth, top = 0, 0
    for s in range(num):
        width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
        size = height - width
        for j in range(width):
            floor[j] = SINGULAR * values[at + j * (height + 1)]
        for i in range(top, top + size * size):
            stack[i] = 0.0
        bottom = top
        while depth > 0 and fronts[pending[depth - 1]]['parent'] == s:
            depth -= 1
            bottom = base[depth]
            runs = _runs(fronts, entries, pending[depth], s, run_from, run_to)
            _extend_add(stack, bottom, run_from, run_to, runs, values, at, width, height, top)
        if not partial_cholesky(values, at, width, height, floor):
            return s
        if size > 0:
            schur_update(values, at, width, height, stack, top)
            if bottom < top:
                for i in range(size * size):
                    stack[bottom + i] = stack[top + i]
        pending[depth] = s
        base[depth] = bottom
        depth += 1
        top = bottom + size * size
    return -1


@part
def _runs(fronts: Records, entries: Records, c: int, s: int, run_from: Ints, run_to: Ints) -> int:
    """Rows below the pivots of front c that stay together in its parent s: number of runs.

    Run r takes rows run_from[r]:run_from[r + 1] of the update matrix to row run_to[r] of s.
    """
    begin, end = fronts[c]['start'], fronts[c + 1]['start']
    width, start = fronts[c]['width'], fronts[s]['start']
    runs, next_to = 0, -1
    for p in range(begin + fronts[c + 1]['first'] - fronts[c]['first'], end):
        to = entries[start + entries[p]['above']]['local']
        local = entries[p]['local']
        if to != next_to:
            run_from[runs] = local - width
            run_to[runs] = to
            runs += 1
        after = entries[p + 1]['local'] if p + 1 < end else fronts[c]['height']
        next_to = to + after - local
    run_from[runs] = fronts[c]['height'] - width
    return runs


@part
def _extend_add(
    stack: Array, c: int, run_from: Ints, run_to: Ints, runs: int,
    values: Array, at: int, width: int, height: int, u: int,
) -> None:  # fmt: skip
    """Add the update matrix of a child at stack[c] to the panel at values[at] and to stack[u]."""
    size = run_from[runs]
    below = height - width
    for r in range(runs):
        for i in range(run_from[r], run_from[r + 1]):
            column = run_to[r] + i - run_from[r]
            for q in range(r, runs):
                a = i if q == r else run_from[q]
                length = run_from[q + 1] - a
                row = run_to[q] + a - run_from[q]
                source = stack[c + i * size + a : c + i * size + a + length]
                if column < width:
                    b = at + column * height + row
                    target = values[b : b + length]
                else:
                    b = u + (column - width) * below + row - width
                    target = stack[b : b + length]
                for k in range(length):
                    target[k] += source[k]


@part
def solve_lower(fronts: Records, entries: Records, values: Array, x: Array) -> None:
    """X becomes L^-1 x, by positions."""
    work = np.empty(highest(fronts))
    for s in range(len(fronts) - 1):
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
    """X becomes L^-T x, by positions."""
    work = np.empty(highest(fronts))
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
