# SPDX-License-Identifier: Apache-2.0
"""Blocks of the inverse of the normal matrix from its multifrontal factor.

Selected inversion (Takahashi, Fagan & Chin 1973; Erisman & Tinney 1975), front by front from the
root: the part of the inverse that belongs to the rows below a front's pivots lies in the front of
its parent, and with z = Z[below, below] l and the column l of the factor below its pivot d

    Z[below, j] = -z / d,    Z[j, j] = (1 / d - l^T Z[below, j]) / d.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.packed_system import System
from rlml_slam.graph.sparse.multifrontal import lower_step, max_height, solve_lower, solve_upper
from rlml_slam.graph.sparse.symbolic_analysis import Ints, Records
from rlml_slam.se2 import Array


@kernel
def selected_blocks(system: System, of_edges: bool) -> tuple[Array, Array]:
    """Blocks of H^-1: of each variable (v, 3, 3), of each edge (e, 3, 3) rows i and columns j.

    The factor of H is in the panels. Without ``of_edges`` the latter are zeros.
    """
    fronts, entries, values = system.fronts, system.entries, system.values
    variables, order = system.variables, system.structure.order
    num = len(fronts) - 1
    blocks = np.zeros((len(variables), 3, 3))
    edges = system.edges
    cross = np.zeros((len(edges), 3, 3))
    by_front = np.argsort(edges['block']) if of_edges else np.empty(0, np.int64)
    left = len(by_front)
    # full inverses of the fronts from the root to the current one
    stack = np.empty(_deepest(fronts))
    pending = np.empty(num + 1, np.int64)
    base = np.empty(num + 1, np.int64)
    depth, top = 0, 0
    for s in range(num - 1, -1, -1):
        width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
        while depth > 0 and pending[depth - 1] != fronts[s]['parent']:
            depth -= 1
            top = base[depth]
        if depth > 0:
            _gather(fronts, entries, s, pending[depth - 1], stack, base[depth - 1], top)
        for j in range(width - 1, -1, -1):
            _column(values, at + j * height, stack, top, height, j)
        p = fronts[s]['start']
        for k in range(fronts[s]['first'], fronts[s + 1]['first']):
            a = order[k]
            i = entries[p]['local']
            for r in range(variables[a]['size']):
                for c in range(variables[a]['size']):
                    blocks[a, r, c] = stack[top + (i + c) * height + i + r]
            p += 1
        while left > 0 and edges[by_front[left - 1]]['block'] >= at:
            left -= 1
            f = by_front[left]
            # of the variable that goes first are the columns
            first, later = edges[f]['a'], edges[f]['b']
            turned = variables[first]['scalar'] < variables[later]['scalar']
            k = top + edges[f]['block'] - at
            for r in range(3):
                for c in range(3):
                    value = stack[k + c * height + r]
                    if turned:
                        cross[f, c, r] = value
                    else:
                        cross[f, r, c] = value
        pending[depth] = s
        base[depth] = top
        depth += 1
        top += height * height
    return blocks, cross


@part
def _deepest(fronts: Records) -> int:
    """Most elements that the fronts from a root to a leaf have together."""
    num = len(fronts) - 1
    path = np.empty(num + 1, np.int64)
    most = 0
    for s in range(num - 1, -1, -1):
        up = fronts[s]['parent']
        path[s] = fronts[s]['height'] * fronts[s]['height'] + (path[up] if up >= 0 else 0)
        most = max(most, path[s])
    return most


@part
def _gather(
    fronts: Records, entries: Records, s: int, up: int, stack: Array, source: int, target: int
) -> None:
    """Copy the inverse of the rows below the pivots of s from the front of its parent."""
    begin, end = fronts[s]['start'], fronts[s + 1]['start']
    begin += fronts[s + 1]['first'] - fronts[s]['first']
    height, tall = fronts[s]['height'], fronts[up]['height']
    rows = np.empty(height, np.int64)
    for p in range(begin, end):
        i = entries[p]['local']
        after = entries[p + 1]['local'] if p + 1 < end else height
        row = entries[fronts[up]['start'] + entries[p]['above']]['local']
        for r in range(after - i):
            rows[i + r] = row + r
    width = fronts[s]['width']
    for c in range(width, height):
        a = source + rows[c] * tall
        b = target + c * height
        for r in range(width, height):
            stack[b + r] = stack[a + rows[r]]


@part
def _column(values: Array, at: int, stack: Array, top: int, height: int, j: int) -> None:
    """Column and row j of a front's inverse, with all later ones at hand."""
    rows = height - j - 1
    L = values[at + j + 1 : at + height]
    Z = stack[top + j * height + j + 1 : top + (j + 1) * height]
    for i in range(rows):
        Z[i] = 0.0
    k = 0
    while k + 3 < rows:
        a = top + (j + 1 + k) * height + j + 1
        A0 = stack[a : a + rows]
        A1 = stack[a + height : a + height + rows]
        A2 = stack[a + 2 * height : a + 2 * height + rows]
        A3 = stack[a + 3 * height : a + 3 * height + rows]
        x0, x1, x2, x3 = L[k], L[k + 1], L[k + 2], L[k + 3]
        for i in range(rows):
            Z[i] += (A0[i] * x0 + A1[i] * x1) + (A2[i] * x2 + A3[i] * x3)
        k += 4
    while k < rows:
        a = top + (j + 1 + k) * height + j + 1
        A0 = stack[a : a + rows]
        x0 = L[k]
        for i in range(rows):
            Z[i] += A0[i] * x0
        k += 1
    d = 1.0 / values[at + j]
    total = d
    for i in range(rows):
        Z[i] *= -d
        total -= L[i] * Z[i]
        stack[top + (j + 1 + i) * height + j] = Z[i]
    stack[top + j * height + j] = total * d


@kernel
def columns(system: System, which: Ints) -> Array:
    """Columns ``which`` (k,) of H^-1 as rows (k, n), with the factor of H in the panels."""
    out = np.zeros((len(which), len(system.g)))
    for k in range(len(which)):
        x = out[k]
        x[which[k]] = 1.0
        solve_lower(system.fronts, system.entries, system.values, x)
        solve_upper(system.fronts, system.entries, system.values, x)
    return out


@kernel
def joint(system: System, which: Ints) -> Array:
    """Rows and columns ``which`` (k,) of H^-1 (k, k), with the factor of H in the panels.

    With H = L L^T it is Y^T Y of the columns Y = L^-1 E, and each of these is zero but in the
    fronts from its own one to the root.
    """
    fronts, entries = system.fronts, system.entries
    num, k = len(fronts) - 1, len(which)
    owner = np.empty(len(system.g), np.int64)
    for s in range(num):
        own = entries[fronts[s]['start']]['scalar']
        owner[own : own + fronts[s]['width']] = s
    Y = np.empty((k, len(system.g)))
    work = np.empty(max_height(fronts))
    met = np.empty(num, np.int64)  # the last column whose way to the root a front was on
    met[:] = -1
    out = np.empty((k, k))
    for a in range(k):
        s = owner[which[a]]
        while s >= 0:
            own = entries[fronts[s]['start']]['scalar']
            Y[a, own : own + fronts[s]['width']] = 0.0
            met[s] = a
            s = fronts[s]['parent']
        Y[a, which[a]] = 1.0
        s = owner[which[a]]
        while s >= 0:
            lower_step(fronts, entries, system.values, s, Y[a], work)
            s = fronts[s]['parent']
        for b in range(a + 1):
            total = 0.0
            s = owner[which[b]]
            while s >= 0:
                if met[s] == a:
                    own = entries[fronts[s]['start']]['scalar']
                    for r in range(own, own + fronts[s]['width']):
                        total += Y[a, r] * Y[b, r]
                s = fronts[s]['parent']
            out[a, b] = out[b, a] = total
    return out
