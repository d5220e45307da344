# SPDX-License-Identifier: Apache-2.0
"""Fill-reducing order of a small graph: minimum degree on an adjacency matrix of bits.

With 64 neighbours to a word, eliminating a node is a few words or-ed into each of its neighbours'
rows, and a count of bits is the degree, exactly. Up to some thousand nodes that is several times
faster than approximate minimum degree on lists, most of all around landmarks, whose long lists
are traversed again at every pose that is eliminated.

As there, indistinguishable nodes are merged, and the degree is the external one: a node's own
twins do not count (Amestoy, Davis & Duff 1996). They are noticed among the neighbours of a pivot,
and of those with rows of one length, by the last one alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.compiled import intrinsic, part
from rlml_slam.graph.sparse.symbolic_analysis import Ints


def _count_bits(_typing: Any, word: Any) -> Any:
    """Typing and code of ones: one instruction."""
    from numba import types

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.int64(word), generate


_ones: Any = intrinsic(_count_bits)


@part
def minimum_degree_of_bits(start: Ints, neighbours: Ints) -> Ints:
    """Elimination order (n,) of a graph in compressed rows: order[k] is eliminated k-th.

    ``neighbours[start[i]:start[i + 1]]`` are those of node i: symmetric, without i itself and
    without repetition. Among nodes of the same degree the next one after the last pivot is taken.
    """
    n = len(start) - 1
    words = (n + 63) >> 6
    rows = np.zeros((n, words), np.int64)  # with a node's own bit, and those of its twins
    degree = np.empty(n, np.int64)  # -1: eliminated, or merged into a twin
    size = np.empty(n, np.int64)
    twin = np.empty(n, np.int64)  # the next one of those merged into a node, or -1
    end = np.empty(n, np.int64)  # the last of these
    num = np.zeros(n + 1, np.int64)  # nodes by degree
    alike = np.empty(n + 1, np.int64)  # by length of row, a neighbour of the pivot, or -1
    for i in range(n):
        for p in range(start[i], start[i + 1]):
            rows[i, neighbours[p] >> 6] |= 1 << (neighbours[p] & 63)
        rows[i, i >> 6] |= 1 << (i & 63)
        degree[i] = start[i + 1] - start[i]
        num[degree[i]] += 1
        size[i], twin[i], end[i] = 1, -1, i
        alike[i] = -1
    alike[n] = -1
    order = np.empty(n, np.int64)
    done, least, pivot = 0, 0, -1
    while done < n:
        while num[least] == 0:
            least += 1
        pivot = pivot + 1 if pivot + 1 < n else 0
        while degree[pivot] != least:
            pivot = pivot + 1 if pivot + 1 < n else 0
        num[least] -= 1
        done = _take(pivot, degree, twin, order, done)
        if least == n - done:  # all that is left touches all that is left
            for i in range(n):
                if degree[i] >= 0:
                    done = _take(i, degree, twin, order, done)
            break
        for w in range(words):
            bits = rows[pivot, w]
            while bits != 0:
                i = (w << 6) + _ones((bits - 1) & ~bits)  # the lowest one
                bits &= bits - 1
                if degree[i] < 0:
                    continue
                length = _join(rows, i, pivot, twin)
                num[degree[i]] -= 1
                t = alike[length]
                if t >= 0 and _same(rows, i, t):
                    num[degree[t]] -= 1
                    degree[i] = -1
                    size[t] += size[i]
                    twin[end[t]] = i
                    end[t] = end[i]
                    i = t
                alike[length] = i
                degree[i] = length - size[i]
                num[degree[i]] += 1
                least = min(least, degree[i])
        for w in range(words):
            bits = rows[pivot, w]
            while bits != 0:
                i = (w << 6) + _ones((bits - 1) & ~bits)
                bits &= bits - 1
                if degree[i] >= 0:
                    alike[degree[i] + size[i]] = -1
    return order


@part
def _take(i: int, degree: Ints, twin: Ints, order: Ints, done: int) -> int:
    """Put node i and its twins into the order."""
    degree[i] = -1
    while i >= 0:
        order[done] = i
        done += 1
        i = twin[i]
    return done


@part
def _join(rows: Ints, i: int, pivot: int, twin: Ints) -> int:
    """Row i after the elimination of a neighbour and its twins; number of nodes in it."""
    words = rows.shape[1]
    for w in range(words):
        rows[i, w] |= rows[pivot, w]
    k = pivot
    while k >= 0:
        rows[i, k >> 6] &= ~(1 << (k & 63))
        k = twin[k]
    length = 0
    for w in range(words):
        length += _ones(rows[i, w])
    return length


@part
def _same(rows: Ints, i: int, j: int) -> bool:
    """Whether two rows are the same."""
    same = True
    for w in range(rows.shape[1]):
        same &= rows[i, w] == rows[j, w]
    return same
