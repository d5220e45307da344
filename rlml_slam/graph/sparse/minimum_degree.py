# SPDX-License-Identifier: Apache-2.0
"""Fill-reducing order of a sparse symmetric matrix: approximate minimum degree.

The quotient-graph algorithm of Amestoy, Davis and Duff, "An approximate minimum degree ordering
algorithm", SIAM J. Matrix Anal. Appl. 17 (1996), written from the paper: eliminated nodes become
elements, whose members bound the degree of a variable; elements inside the newest one are
absorbed, indistinguishable variables are merged and eliminated together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import part

Ints = NDArray[np.int64]


@part
def minimum_degree(start: Ints, neighbours: Ints, weight: Ints) -> Ints:
    """Elimination order (n,) of a graph in compressed rows: order[k] is eliminated k-th.

    ``neighbours[start[i]:start[i + 1]]`` are those of node i: symmetric, without i itself and
    without repetition. ``weight`` (n,) is the number of scalar rows of each node; a node of weight
    0 is one that has been eliminated before, whose neighbours touch each other therefore. Such
    nodes come first among the neighbours of another one, and have no such neighbours themselves.
    The neighbours of a node that is heavier than all others together are eliminated last.
    """
    n = len(start) - 1
    if n == 0:
        return np.empty(0, np.int64)
    free = start[n]
    # loops instead of slices and np.full: they compile in a tenth of the time
    lists = np.empty(free + free // 2 + 2 * n + 16, np.int64)
    for p in range(free):
        lists[p] = neighbours[p]
    first = np.empty(n, np.int64)
    length = np.empty(n, np.int64)
    # number of elements at the head of a variable's list; -1 for an element or a merged variable
    elements = np.empty(n, np.int64)
    size = np.empty(n, np.int64)  # 0 when merged, negative while in the newest element
    degree = np.empty(n, np.int64)
    mark = np.empty(n, np.int64)  # 0: dead element
    absorbed = np.empty(n, np.int64)  # into which node, or -1
    rank = np.empty(n, np.int64)
    after = np.empty(n, np.int64)
    before = np.empty(n, np.int64)
    bucket = np.empty(n, np.int64)  # lists of variables by hash
    chain = np.empty(n, np.int64)
    key = np.empty(n, np.int64)
    total = 0
    for i in range(n):
        first[i] = start[i]
        length[i] = start[i + 1] - start[i]
        elements[i] = 0 if weight[i] > 0 else -1
        size[i] = weight[i]
        mark[i] = 1
        absorbed[i] = rank[i] = bucket[i] = chain[i] = -1
        total += weight[i]
        degree[i] = 0
        for p in range(start[i], start[i + 1]):
            degree[i] += weight[neighbours[p]]
    head = np.empty(total + 1, np.int64)  # lists of variables by degree
    for d in range(total + 1):
        head[d] = -1
    largest = 0
    for i in range(n):
        if weight[i] == 0:
            largest = max(largest, degree[i])
            continue
        d = degree[i]
        for p in range(start[i], start[i + 1]):
            e = neighbours[p]
            if weight[e] > 0:
                break
            elements[i] += 1
            d += degree[e] - weight[i]
        degree[i] = min(d, total - weight[i])
        if 2 * weight[i] > total:
            degree[i] = total
        _link(head, after, before, degree[i], i)
    done, lowest, flag, pivots = 0, 0, 2, 0
    while done < total:
        while head[lowest] < 0:
            lowest += 1
        me = head[lowest]
        _unlink(head, after, before, lowest, me)
        pivot_size = size[me]
        done += pivot_size

        # the members of the new element: of the elements next to me, and next to me directly
        bound = length[me]
        for p in range(first[me], first[me] + elements[me]):
            bound += length[lists[p]]
        if free + bound > len(lists):
            lists, free = _compact(lists, first, length, size, mark, elements, bound)
        size[me] = -pivot_size
        me_degree = 0
        members = free
        q = members
        end = first[me] + length[me]
        for p in range(first[me], end + 1):
            if p < first[me] + elements[me]:
                e = lists[p]
                a, b = first[e], first[e] + length[e]
                absorbed[e] = me
                mark[e] = 0
            elif p == end:
                a, b = first[me] + elements[me], end
            else:
                continue
            for r in range(a, b):
                i = lists[r]
                if size[i] > 0:
                    me_degree += size[i]
                    size[i] = -size[i]
                    lists[q] = i
                    q += 1
                    _unlink(head, after, before, degree[i], i)
        first[me] = members
        elements[me] = -1

        # mark[e] - flag becomes the size of e outside the new element
        for p in range(members, q):
            i = lists[p]
            own = -size[i]
            for r in range(first[i], first[i] + elements[i]):
                e = lists[r]
                if mark[e] >= flag:
                    mark[e] -= own
                elif mark[e] != 0:
                    mark[e] = degree[e] + flag - own

        for p in range(members, q):
            i = lists[p]
            a = first[i]
            w = a
            d = 0
            h = 0
            for r in range(a, a + elements[i]):
                e = lists[r]
                if mark[e] != 0:
                    outside = mark[e] - flag
                    if outside > 0:
                        d += outside
                        lists[w] = e
                        w += 1
                        h += e
                    else:  # e lies inside the new element
                        absorbed[e] = me
                        mark[e] = 0
            variables = w
            for r in range(a + elements[i], a + length[i]):
                j = lists[r]
                if size[j] > 0:
                    d += size[j]
                    lists[w] = j
                    w += 1
                    h += j
            if w == a:  # only in the new element: eliminated with me
                absorbed[i] = me
                own = -size[i]
                me_degree -= own
                pivot_size += own
                done += own
                size[i] = 0
                elements[i] = -1
            else:
                degree[i] = min(degree[i], d)
                # me becomes the first element; at least one slot has become free
                lists[w] = lists[variables]
                lists[variables] = lists[a]
                lists[a] = me
                elements[i] = variables - a + 1
                length[i] = w - a + 1
                h %= n
                key[i] = h
                chain[i] = bucket[h]
                bucket[h] = i
        largest = max(largest, me_degree)
        degree[me] = me_degree
        flag += largest + 1

        # merge indistinguishable variables: same elements, same variables
        for p in range(members, q):
            if size[lists[p]] >= 0:
                continue
            h = key[lists[p]]
            i = bucket[h]
            bucket[h] = -1
            while i >= 0 and chain[i] >= 0:
                for r in range(first[i] + 1, first[i] + length[i]):
                    mark[lists[r]] = flag
                last = i
                j = chain[i]
                while j >= 0:
                    same = length[j] == length[i] and elements[j] == elements[i]
                    r = first[j] + 1
                    while same and r < first[j] + length[j]:
                        same = mark[lists[r]] == flag
                        r += 1
                    if same:
                        absorbed[j] = i
                        size[i] += size[j]
                        size[j] = 0
                        elements[j] = -1
                        chain[last] = chain[j]
                    else:
                        last = j
                    j = chain[j]
                flag += 1
                i = chain[i]

        # the members that are left, with their new degrees
        w = members
        left = total - done
        for p in range(members, q):
            i = lists[p]
            if size[i] < 0:
                own = -size[i]
                size[i] = own
                d = max(0, min(degree[i] + me_degree - own, left - own))
                degree[i] = d
                _link(head, after, before, d, i)
                lowest = min(lowest, d)
                lists[w] = i
                w += 1
        size[me] = pivot_size
        length[me] = w - members
        mark[me] = 1 if w > members else 0
        free = w
        rank[me] = pivots
        pivots += 1
    return _order(rank, absorbed, pivots)


@part
def _link(head: Ints, after: Ints, before: Ints, d: int, i: int) -> None:
    """Put i at the head of the list of degree d."""
    j = head[d]
    after[i] = j
    before[i] = -1
    if j >= 0:
        before[j] = i
    head[d] = i


@part
def _unlink(head: Ints, after: Ints, before: Ints, d: int, i: int) -> None:
    """Take i out of the list of degree d."""
    if after[i] >= 0:
        before[after[i]] = before[i]
    if before[i] >= 0:
        after[before[i]] = after[i]
    else:
        head[d] = after[i]


@part
def _compact(
    lists: Ints, first: Ints, length: Ints, size: Ints, mark: Ints, elements: Ints, need: int
) -> tuple[Ints, int]:
    """Copy the live lists to a new buffer with room for ``need`` more entries."""
    live = 0
    for i in range(len(first)):
        if (elements[i] >= 0 and size[i] != 0) or (elements[i] < 0 and mark[i] != 0):
            live += length[i]
    new = np.empty(max(len(lists), 2 * (live + need)), np.int64)
    free = 0
    for i in range(len(first)):
        if (elements[i] >= 0 and size[i] != 0) or (elements[i] < 0 and mark[i] != 0):
            for p in range(length[i]):
                new[free + p] = lists[first[i] + p]
            first[i] = free
            free += length[i]
    return new, free


@part
def _order(rank: Ints, absorbed: Ints, pivots: int) -> Ints:
    """Nodes by the rank of the pivot that they were eliminated with."""
    n = len(rank)
    for i in range(n):
        top = i
        while rank[top] < 0:
            top = absorbed[top]
        j = i
        while rank[j] < 0:
            rank[j] = rank[top]
            j = absorbed[j]
    where = np.empty(pivots + 1, np.int64)
    for k in range(pivots + 1):
        where[k] = 0
    for i in range(n):
        where[rank[i] + 1] += 1
    for k in range(pivots):
        where[k + 1] += where[k]
    order = np.empty(n, np.int64)
    for i in range(n):
        order[where[rank[i]]] = i
        where[rank[i]] += 1
    return order
