# SPDX-License-Identifier: Apache-2.0
"""Symbolic analysis of the normal equations on the block graph, once per structure.

A block is one unknown pose or landmark. Blocks are eliminated in the order of approximate
minimum degree, postordered; consecutive blocks with (nearly) the same rows form a supernode. The
front of a supernode is the list of its own blocks and of the later blocks that they touch; the
multifrontal factorisation works on one dense front at a time (Duff & Reid 1983; Liu 1992).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import part

Ints = NDArray[np.int64]
Records = NDArray[np.void]

# A supernode: it owns the positions from ``first`` to the next one's; its front is the entries
# from ``start`` to the next one's; ``parent`` or -1; ``side`` 0 or 1 alternates from parent to
# child. The panel of its ``width`` own columns of ``height`` rows lies at ``panel`` of the values,
# column by column. A last record closes the rows.
FRONT = np.dtype(
    [(k, np.int64) for k in ('first', 'start', 'parent', 'side', 'width', 'height', 'panel')]
)

# A block row of a front, own ones first and all ascending: its ``position`` in the elimination
# order, the entry of the parent's front that is ``above`` it (-1 for own ones), its first row in
# this front (``local``) and in the whole matrix (``scalar``).
ENTRY = np.dtype([(k, np.int64) for k in ('position', 'above', 'local', 'scalar')])


class Structure(NamedTuple):
    """Fronts of a block matrix of n variables, without the fields that depend on sizes.

    ``order[k]`` is the variable eliminated k-th, ``position`` its inverse and ``owner`` (n,) the
    supernode of each position. ``entry[f]`` is the entry, in the front of its earlier variable,
    of the later variable of pair f, -1 for a pair that joins nothing.
    """

    order: Ints
    position: Ints
    owner: Ints
    fronts: Records
    entries: Records
    entry: Ints


@part
def _filled(n: int, value: int) -> Ints:
    out = np.empty(n, np.int64)
    for i in range(n):
        out[i] = value
    return out


@part
def adjacency(pairs: Ints, num: int) -> tuple[Ints, Ints]:
    """Compressed rows (start, neighbours) without repetition."""
    start = _filled(num + 2, 0)
    for f in range(len(pairs)):
        a, b = pairs[f, 0], pairs[f, 1]
        if a >= 0 and b >= 0:
            start[a + 2] += 1
            start[b + 2] += 1
    for i in range(num):
        start[i + 2] += start[i + 1]
    # after this fill start[i + 1] is where row i ends, so start[:num + 1] are the row pointers
    neighbours = np.empty(start[num + 1], np.int64)
    for f in range(len(pairs)):
        a, b = pairs[f, 0], pairs[f, 1]
        if a >= 0 and b >= 0:
            neighbours[start[a + 1]] = b
            start[a + 1] += 1
            neighbours[start[b + 1]] = a
            start[b + 1] += 1
    seen = _filled(num, -1)
    out = np.empty(num + 1, np.int64)
    w = 0
    for i in range(num):
        out[i] = w
        for p in range(start[i], start[i + 1]):
            j = neighbours[p]
            if seen[j] != i:
                seen[j] = i
                neighbours[w] = j
                w += 1
    out[num] = w
    return out, neighbours


@part
def elimination_tree(start: Ints, neighbours: Ints, order: Ints) -> tuple[Ints, Ints, Ints]:
    """(order, parent, count): postordered, with parents and below-diagonal counts by position."""
    n = len(order)
    position = np.empty(n, np.int64)
    for k in range(n):
        position[order[k]] = k
    # Liu's algorithm with path compression
    parent = _filled(n, -1)
    ancestor = _filled(n, -1)
    for k in range(n):
        v = order[k]
        for p in range(start[v], start[v + 1]):
            i = position[neighbours[p]]
            while i < k and i >= 0:
                up = ancestor[i]
                ancestor[i] = k
                if up < 0:
                    parent[i] = k
                i = up if up != k else -1
    post = _postorder(parent)
    new = np.empty(n, np.int64)
    for k in range(n):
        new[post[k]] = k
    out = np.empty(n, np.int64)
    up_new = np.empty(n, np.int64)
    for k in range(n):
        out[new[k]] = order[k]
        up_new[new[k]] = new[parent[k]] if parent[k] >= 0 else -1
    for k in range(n):
        position[out[k]] = k
    # row k of the factor is the subtree that its neighbours span below k
    count = _filled(n, 0)
    mark = ancestor
    for k in range(n):
        mark[k] = k
        v = out[k]
        for p in range(start[v], start[v + 1]):
            i = position[neighbours[p]]
            if i < k:
                while mark[i] != k:
                    mark[i] = k
                    count[i] += 1
                    i = up_new[i]
    return out, up_new, count


@part
def _postorder(parent: Ints) -> Ints:
    """Nodes of a forest, children before parents and each subtree in one run."""
    n = len(parent)
    child = _filled(n, -1)
    sibling = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        up = parent[k]
        if up >= 0:
            sibling[k] = child[up]
            child[up] = k
    out = np.empty(n, np.int64)
    stack = np.empty(n, np.int64)
    w = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        depth = 1
        stack[0] = root
        while depth > 0:
            k = stack[depth - 1]
            if child[k] >= 0:
                stack[depth] = child[k]
                child[k] = sibling[child[k]]
                depth += 1
            else:
                out[w] = k
                w += 1
                depth -= 1
    return out


@part
def _merge(parent: Ints, count: Ints, order: Ints, dims: Ints, widest: int) -> Ints:
    """Last position of the supernode of each position: exact supernodes, then relaxed ones.

    A supernode joins its parent's where that adds few zeros: little work is wasted and much
    overhead saved, because dense loops are longer. None gets wider than ``widest`` rows; what
    would is cut from its end on.
    """
    n = len(parent)
    last = np.empty(n, np.int64)
    cols = _filled(n, 0)  # by last position: own rows, rows of the front, zeros so far
    rows = _filled(n, 0)
    zeros = _filled(n, 0)
    for k in range(n - 1, -1, -1):
        own = dims[order[k]]
        last[k] = k
        alike = k + 1 < n and parent[k] == k + 1 and count[k] == count[k + 1] + 1
        if alike and cols[last[k + 1]] + own <= widest:
            last[k] = last[k + 1]
        cols[last[k]] += own
    # rows below a supernode: the front of the parent holds them all, so a sum of rows suffices
    for k in range(n - 1, -1, -1):
        if last[k] == k:
            rows[k] = cols[k] + 3 * count[k]
    for k in range(n):
        if last[k] != k or parent[k] < 0:
            continue
        up = last[parent[k]]
        wide = cols[k] + cols[up]
        new = zeros[k] + zeros[up] + cols[k] * (rows[up] + cols[k] - rows[k])
        share = new / (wide * (rows[up] + cols[k]))
        if wide <= widest and (
            (wide <= 16 and share < 0.45)
            or (wide <= 48 and share < 0.2)
            or (wide <= 96 and share < 0.08)
            or share < 0.03
        ):
            last[k] = up
            cols[up] = wide
            rows[up] += cols[k]
            zeros[up] = new
    for k in range(n - 1, -1, -1):
        last[k] = last[last[k]]
    return last


@part
def supernodes(
    start: Ints, neighbours: Ints, order: Ints, parent: Ints, count: Ints, pairs: Ints, dims: Ints,
    widest: int,
) -> Structure:  # fmt: skip
    """Fronts of the relaxed supernodes, of ``widest`` own rows at most."""
    n = len(order)
    last = _merge(parent, count, order, dims, widest)
    # supernodes by their last position; members of one become neighbours in the order
    index = _filled(n, -1)
    num = 0
    for k in range(n):
        if last[k] == k:
            index[k] = num
            num += 1
    first = _filled(num + 2, 0)
    up = _filled(num, -1)
    for k in range(n):
        first[index[last[k]] + 2] += 1
        if last[k] == k and parent[k] >= 0:
            up[index[k]] = index[last[parent[k]]]
    for s in range(num):
        first[s + 2] += first[s + 1]
    new_order = np.empty(n, np.int64)
    position = np.empty(n, np.int64)
    owner = np.empty(n, np.int64)
    for k in range(n):
        s = index[last[k]]
        new_order[first[s + 1]] = order[k]
        position[order[k]] = first[s + 1]
        owner[first[s + 1]] = s
        first[s + 1] += 1
    begin, front = _fronts(start, neighbours, new_order, position, owner, first, up)
    above, entry = _entries(begin, front, first, up, owner, position, pairs)
    fronts = np.empty(num + 1, FRONT)
    for s in range(num, -1, -1):
        fronts[s]['first'] = first[s]
        fronts[s]['start'] = begin[s]
        above_s = up[s] if s < num else -1
        fronts[s]['parent'] = above_s
        fronts[s]['side'] = 1 - fronts[above_s]['side'] if above_s >= 0 else 0
    entries = np.empty(len(front), ENTRY)
    for p in range(len(front)):
        entries[p]['position'] = front[p]
        entries[p]['above'] = above[p]
    return Structure(new_order, position, owner, fronts, entries, entry)


@part
def _fronts(
    start: Ints, neighbours: Ints, order: Ints, position: Ints, owner: Ints, first: Ints, up: Ints
) -> tuple[Ints, Ints]:
    """(start, front): own positions, then the later positions that they touch, ascending."""
    n, num = len(order), len(up)
    child = _filled(num, -1)
    sibling = np.empty(num, np.int64)
    for s in range(num - 1, -1, -1):
        if up[s] >= 0:
            sibling[s] = child[up[s]]
            child[up[s]] = s
    begin = _filled(num + 1, 0)
    found = np.empty(4 * n + len(neighbours), np.int64)  # unsorted, grows
    mark = _filled(n, -1)
    w = 0
    for s in range(num):
        begin[s] = w
        end = first[s + 1]
        if w + n > len(found):
            grown = np.empty(2 * len(found) + n, np.int64)
            for p in range(w):
                grown[p] = found[p]
            found = grown
        for k in range(first[s], end):
            v = order[k]
            for p in range(start[v], start[v + 1]):
                i = position[neighbours[p]]
                if i >= end and mark[i] != s:
                    mark[i] = s
                    found[w] = i
                    w += 1
        c = child[s]
        while c >= 0:
            for p in range(begin[c], begin[c + 1]):
                i = found[p]
                if i >= end and mark[i] != s:
                    mark[i] = s
                    found[w] = i
                    w += 1
            c = sibling[c]
        begin[s + 1] = w
    # sort every list at once: supernodes by row, then rows in ascending order back to supernodes
    row = _filled(n + 1, 0)
    for p in range(w):
        row[found[p] + 1] += 1
    for i in range(n):
        row[i + 1] += row[i]
    who = np.empty(w, np.int64)
    for s in range(num):
        for p in range(begin[s], begin[s + 1]):
            who[row[found[p]]] = s
            row[found[p]] += 1
    front_start = np.empty(num + 1, np.int64)
    front = np.empty(w + n, np.int64)
    to = np.empty(num, np.int64)
    for s in range(num + 1):
        front_start[s] = begin[s] + first[s]
    for s in range(num):
        q = front_start[s]
        for k in range(first[s], first[s + 1]):
            front[q] = k
            q += 1
        to[s] = q
    p = 0
    for i in range(n):
        while p < row[i]:
            s = who[p]
            front[to[s]] = i
            to[s] += 1
            p += 1
    return front_start, front


@part
def _entries(
    front_start: Ints, front: Ints, first: Ints, up: Ints, owner: Ints, position: Ints, pairs: Ints
) -> tuple[Ints, Ints]:
    """(above, entry): places in the parent's front, and of factors in the earlier one's front."""
    n, num, k = len(position), len(up), len(pairs)
    above = _filled(len(front), -1)
    entry = _filled(k, -1)
    # factors and children by the supernode whose front they look into
    head = _filled(num, -1)
    chain = np.empty(k, np.int64)
    for f in range(k - 1, -1, -1):
        if pairs[f, 0] >= 0 and pairs[f, 1] >= 0:
            s = owner[min(position[pairs[f, 0]], position[pairs[f, 1]])]
            chain[f] = head[s]
            head[s] = f
    child = _filled(num, -1)
    sibling = np.empty(num, np.int64)
    for s in range(num - 1, -1, -1):
        if up[s] >= 0:
            sibling[s] = child[up[s]]
            child[up[s]] = s
    place = np.empty(n, np.int64)
    for s in range(num):
        for p in range(front_start[s], front_start[s + 1]):
            place[front[p]] = p - front_start[s]
        f = head[s]
        while f >= 0:
            entry[f] = place[max(position[pairs[f, 0]], position[pairs[f, 1]])]
            f = chain[f]
        c = child[s]
        while c >= 0:
            own = first[c + 1] - first[c]
            for p in range(front_start[c] + own, front_start[c + 1]):
                above[p] = place[front[p]]
            c = sibling[c]
    return above, entry
