# SPDX-License-Identifier: Apache-2.0
"""Nodes with at most two neighbours are eliminated before the ordering proper.

They have the minimum degree, and eliminating one joins its two neighbours and changes no other
degree: so a pose graph, which is mostly chains between crossings, shrinks to its crossings at the
price of a few list entries, and minimum degree has the rest only.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.graph.sparse.bitset_minimum_degree import minimum_degree_of_bits
from rlml_slam.graph.sparse.minimum_degree import minimum_degree
from rlml_slam.graph.sparse.symbolic_analysis import Ints

# a node next to one with more neighbours is left to the ordering: its list takes long to search
MANY = 32
# up to so many nodes the rest is ordered on bits: its matrix stays in the cache of a core
FEW = 2560


@part
def elimination_order(start: Ints, neighbours: Ints, weight: Ints) -> Ints:
    """Elimination order (n,) of a graph as ordering.minimum_degree takes it, all with a weight.

    The weights count beyond ``FEW`` nodes; below, that of all nodes is one.
    """
    n = len(start) - 1
    neighbours = neighbours[: start[n]].copy()
    length = np.empty(n, np.int64)
    index = np.empty(n, np.int64)  # of the nodes that are left; -1: eliminated
    order = np.empty(n, np.int64)
    waiting = np.empty(n, np.int64)
    for i in range(n):
        length[i] = start[i + 1] - start[i]
        index[i] = 0
    done = 0
    # the ends of open chains first: they cost nothing
    for most in range(1, 3):
        for i in range(n):
            done = _eliminate(start, neighbours, length, index, most, i, waiting, order, done)
    left, num = np.empty(n - done, np.int64), 0
    for i in range(n):
        if index[i] == 0:
            index[i] = num
            left[num] = i
            num += 1
    new_start = np.empty(num + 1, np.int64)
    new_weight = np.empty(num, np.int64)
    w = 0
    for k in range(num):
        new_start[k] = w
        i = left[k]
        new_weight[k] = weight[i]
        for p in range(start[i], start[i] + length[i]):
            neighbours[w] = index[neighbours[p]]
            w += 1
    new_start[num] = w
    if num <= FEW:
        rest = minimum_degree_of_bits(new_start, neighbours)
    else:
        rest = minimum_degree(new_start, neighbours, new_weight)
    for k in range(num):
        order[done + k] = left[rest[k]]
    return order


@part
def _eliminate(
    start: Ints, neighbours: Ints, length: Ints, index: Ints, most: int, i: int, waiting: Ints,
    order: Ints, done: int,
) -> int:  # fmt: skip
    """Eliminate node i and those before it that this leaves with ``most`` neighbours at most."""
    depth = 1
    waiting[0] = i
    while depth > 0:
        depth -= 1
        v = waiting[depth]
        if index[v] < 0 or length[v] > most:
            continue
        a = neighbours[start[v]] if length[v] > 0 else -1
        b = neighbours[start[v] + 1] if length[v] > 1 else -1
        if (a >= 0 and length[a] > MANY) or (b >= 0 and length[b] > MANY):
            continue
        index[v] = -1
        order[done] = v
        done += 1
        joined = a >= 0 and b >= 0 and not _among(neighbours, start[a], length[a], b)
        for end in range(2):
            u, w = (a, b) if end == 0 else (b, a)
            if u < 0:
                continue
            p = start[u]
            while neighbours[p] != v:
                p += 1
            if joined:
                neighbours[p] = w
            else:
                length[u] -= 1
                neighbours[p] = neighbours[start[u] + length[u]]
        # what has become simple, ends of chains to be taken first; later nodes have their turn
        for simple in range(most, -1, -1):
            for end in range(2):
                u = a if end == 0 else b
                fits = u >= 0 and length[u] == simple and (u < i or simple < 2)
                if fits and not joined and depth < len(waiting):
                    waiting[depth] = u
                    depth += 1
    return done


@part
def _among(neighbours: Ints, first: int, length: int, node: int) -> bool:
    found = False
    for p in range(first, first + length):
        found |= neighbours[p] == node
    return found
