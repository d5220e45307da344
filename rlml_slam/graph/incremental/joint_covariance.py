# SPDX-License-Identifier: Apache-2.0
"""Joint covariances from the tree of the incremental solver, with no new factorisation.

With H = L L^T the block of H^-1 is Y^T Y of the columns Y = L^-1 E, as in inverse.joint, and each
of these is zero but in the cliques from its own one to the root.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.incremental.solver_state import CLIQUES, UNKNOWNS, State
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array


@kernel
def tree_joint(state: State, pool: Array, which: Ints) -> Array:
    """Joint covariance of the unknowns ``which`` (k,), that all are in the tree, row by row."""
    unknowns, cliques, numbers = state.unknowns, state.cliques, pool.view(np.int64)
    # rows of the cliques between the unknowns and the roots, in the order in which they are met
    first = np.full(state.counts[CLIQUES], -1)
    row = np.empty(state.counts[UNKNOWNS], np.int64)
    rows, columns, most = 0, 0, 0
    for n in range(len(which)):
        columns += unknowns[which[n]]['size']
        c = unknowns[which[n]]['clique']
        while c >= 0 and first[c] < 0:
            first[c] = rows
            most = max(most, cliques[c]['height'])
            begin = cliques[c]['block']
            for p in range(begin, begin + cliques[c]['own']):
                row[numbers[p]] = rows
                rows += unknowns[numbers[p]]['size']
            c = cliques[c]['parent']
    Y = np.empty((columns, rows))
    owner = np.empty(columns, np.int64)
    met = np.full(state.counts[CLIQUES], -1)  # the last column whose way to the root it was on
    work = np.empty(most)
    out = np.empty((columns, columns))
    a = 0
    for n in range(len(which)):
        u = unknowns[which[n]]
        for r in range(u['size']):
            owner[a] = c = u['clique']
            while c >= 0:
                Y[a, first[c] : first[c] + cliques[c]['width']] = 0.0
                met[c] = a
                c = cliques[c]['parent']
            Y[a, row[which[n]] + r] = 1.0
            c = owner[a]
            while c >= 0:
                _forward_step(state, pool, numbers, c, first[c], row, Y[a], work)
                c = cliques[c]['parent']
            for b in range(a + 1):
                total = 0.0
                c = owner[b]
                while c >= 0:
                    if met[c] == a:
                        for k in range(first[c], first[c] + cliques[c]['width']):
                            total += Y[a, k] * Y[b, k]
                    c = cliques[c]['parent']
                out[a, b] = out[b, a] = total
            a += 1
    return out


@part
def _forward_step(
    state: State, pool: Array, numbers: Ints, c: int, first: int, row: Ints, x: Array, work: Array
) -> None:
    """Clique c's part in the forward solve; its own rows begin at ``first`` of x."""
    clique = state.cliques[c]
    width, height = clique['width'], clique['height']
    panel = clique['block'] + clique['members']
    for j in range(width):
        work[j] = x[first + j]
    for i in range(width, height):
        work[i] = 0.0
    for j in range(width):
        a = panel + j * (height + 1)
        y = work[j] / pool[a + j]
        x[first + j] = y
        L, w = pool[a + j + 1 : a + height], work[j + 1 : height]
        for i in range(height - j - 1):
            w[i] -= y * L[i]
    k = width
    for p in range(clique['block'] + clique['own'], clique['block'] + clique['members']):
        v = numbers[p]
        for r in range(state.unknowns[v]['size']):
            x[row[v] + r] += work[k]
            k += 1
