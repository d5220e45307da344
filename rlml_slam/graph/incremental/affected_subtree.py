# SPDX-License-Identifier: Apache-2.0
"""Affected part of the clique tree, and its new structure.

Replaced are the cliques of the affected unknowns and all cliques above them; the subtrees below
stay as they are and count as eliminated: a node of size 0 that joins its separator.
The unknowns with new factors are eliminated last, so that the next ones find them near the root;
not where these are more than fit there: an order that keeps many for the end fills the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.graph.incremental.solver_state import SEEDS, STEP, State, free_clique
from rlml_slam.graph.sparse.minimum_degree import minimum_degree
from rlml_slam.graph.sparse.multifrontal import layout_fronts
from rlml_slam.graph.sparse.symbolic_analysis import (
    Ints,
    Records,
    adjacency,
    elimination_tree,
    supernodes,
)

# rows that a clique owns at most: what the next step touches is near the end of the root, and a
# wide root in one piece would be factored as a whole for it. Wider ones save little: taking an
# update matrix over costs some operations per number, making it as many as there are rows.
MAX_OWN_ROWS = 48


class AffectedPart(NamedTuple):
    """Unknowns (m,) that are eliminated again and cliques (k,) that stay below them.

    ``order``, ``position``, ``fronts`` and ``entries`` as in symbolic_analysis.Structure. Nodes
    are the unknowns, 0..m, a node m that keeps the newest ones last, and the cliques, m + 1..
    """

    unknowns: Ints
    cliques: Ints
    order: Ints
    position: Ints
    fronts: Records
    entries: Records


@part
def extract_affected(state: State, numbers: Ints) -> AffectedPart:
    """Remove the affected part from the tree and find its new structure.

    Sets ``local`` of its unknowns; the cliques that stay have no parent until they get a new one.
    """
    unknowns, below = _affected(state, numbers)
    m, k = len(unknowns), len(below)
    cliques, step = state.cliques, state.counts[STEP]
    num = 0
    for n in range(k):
        num += cliques[below[n]]['members'] - cliques[below[n]]['own']
    for n in range(m):
        u = state.unknowns[unknowns[n]]
        num += 1 + (u['links'] if u['size'] == 3 else 0)
    pairs = np.empty((num, 2), np.int64)
    w = 0
    for n in range(k):
        clique = cliques[below[n]]
        first = clique['block']
        for p in range(first + clique['own'], first + clique['members']):
            pairs[w, 0], pairs[w, 1] = m + 1 + n, state.unknowns[numbers[p]]['local']
            w += 1
    dims = np.zeros(m + 1 + k, np.int64)
    total, late = 0, 0
    for n in range(m):
        dims[n] = state.unknowns[unknowns[n]]['size']
        total += dims[n]
        if state.unknowns[unknowns[n]]['last_change'] == step:
            late += dims[n]
    for n in range(m):
        v = unknowns[n]
        if late <= MAX_OWN_ROWS and state.unknowns[v]['last_change'] == step:
            pairs[w, 0], pairs[w, 1] = m, n
            w += 1
        # every factor between two unknowns starts from a pose
        link = state.unknowns[v]['head'] if dims[n] == 3 else -1
        while link >= 0:
            z = state.factors[link // 2]
            if link % 2 == 0 and z['b'] >= 0 and state.unknowns[z['b']]['local'] >= 0:
                pairs[w, 0], pairs[w, 1] = n, state.unknowns[z['b']]['local']
                w += 1
            link = z['next_a'] if link % 2 == 0 else z['next_b']
    start, neighbours = adjacency(pairs[:w], m + 1 + k)
    # the node that keeps the late ones last is heavier than all others together
    dims[m] = total + 1
    order = minimum_degree(start, neighbours, dims)
    dims[m] = 0
    order, parent, count = elimination_tree(start, neighbours, _eliminated_first(order, m))
    structure = supernodes(start, neighbours, order, parent, count, pairs[:0], dims, MAX_OWN_ROWS)
    fronts, entries, _ = layout_fronts(structure, dims)
    return AffectedPart(unknowns, below, structure.order, structure.position, fronts, entries)


@part
def _eliminated_first(order: Ints, m: int) -> Ints:
    """The order with the cliques' nodes first and node m last."""
    out = np.empty(len(order), np.int64)
    w = 0
    for k in range(len(order)):
        if order[k] > m:
            out[w] = order[k]
            w += 1
    for k in range(len(order)):
        if order[k] < m:
            out[w] = order[k]
            w += 1
    out[w] = m
    return out


@part
def _affected(state: State, numbers: Ints) -> tuple[Ints, Ints]:
    """(unknowns to be eliminated again, cliques below them); the cliques between are freed."""
    unknowns, cliques, step = state.unknowns, state.cliques, state.counts[STEP]
    most = 64
    removed = np.empty(most, np.int64)
    num, num_unknowns, num_below = 0, 0, 0
    for n in range(state.counts[SEEDS]):
        c = unknowns[state.seeds[n]]['clique']
        num_unknowns += c < 0
        while c >= 0 and cliques[c]['mark'] != step:
            cliques[c]['mark'] = step
            num_unknowns += cliques[c]['own']
            if num == most:
                most *= 2
                more = np.empty(most, np.int64)
                more[:num] = removed
                removed = more
            removed[num] = c
            num += 1
            c = cliques[c]['parent']
    out = np.empty(num_unknowns, np.int64)
    w = 0
    for n in range(state.counts[SEEDS]):
        if unknowns[state.seeds[n]]['clique'] < 0:
            w = _add(state, state.seeds[n], out, w)
    for n in range(num):
        first = cliques[removed[n]]['block']
        for p in range(first, first + cliques[removed[n]]['own']):
            w = _add(state, numbers[p], out, w)
        c = cliques[removed[n]]['child']
        while c >= 0:
            num_below += cliques[c]['mark'] != step
            c = cliques[c]['next']
    below = np.empty(num_below, np.int64)
    num_below = 0
    for n in range(num):
        c = cliques[removed[n]]['child']
        while c >= 0:
            after = cliques[c]['next']
            if cliques[c]['mark'] != step:
                below[num_below] = c
                num_below += 1
                cliques[c]['parent'] = -1
            c = after
    for n in range(num):
        free_clique(state, numbers, removed[n])
    return out[:w], below


@part
def _add(state: State, v: int, out: Ints, w: int) -> int:
    """Add unknown v to the part unless no factor is left on it."""
    u = state.unknowns[v]
    u['clique'] = -1
    if u['links'] == 0:
        return w
    u['local'] = w
    out[w] = v
    return w + 1
