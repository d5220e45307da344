# SPDX-License-Identifier: Apache-2.0
import numba
import numpy as np
import pytest
from numba_modules import compiled_by_numba

order, degree, analysis = compiled_by_numba(
    'elimination_order', 'minimum_degree', 'symbolic_analysis'
)
FEW, elimination_order = order.FEW, order.elimination_order
minimum_degree, adjacency = degree.minimum_degree, analysis.adjacency


@numba.njit
def order_of(pairs, num):
    start, neighbours = adjacency(pairs, num)
    return elimination_order(start, neighbours, np.full(num, 3))


@numba.njit
def order_by_lists(pairs, num):
    start, neighbours = adjacency(pairs, num)
    return minimum_degree(start, neighbours, np.full(num, 3))


def fill(pairs, order):
    """Blocks that elimination in this order adds to those of the pairs."""
    neighbours = {int(i): set() for i in order}
    for i, j in pairs:
        neighbours[int(i)].add(int(j))
        neighbours[int(j)].add(int(i))
    added = 0
    for v in order:
        around = neighbours.pop(int(v))
        for i in around:
            neighbours[i].discard(int(v))
            new = around - neighbours[i] - {i}
            added += len(new)
            neighbours[i] |= new
    return added // 2


@pytest.mark.parametrize('seed', range(5))
def test_trees_are_eliminated_without_fill(seed):
    rng = np.random.default_rng(seed)
    n = 200
    names = rng.permutation(n)
    pairs = np.array([(names[i], names[rng.integers(max(0, i - 9), i)]) for i in range(1, n)])
    order = order_of(pairs, n)
    assert sorted(order) == list(range(n))
    assert fill(pairs, order) == 0


@pytest.mark.parametrize('seed', range(5))
def test_a_ring_takes_the_fewest_chords(seed):
    rng = np.random.default_rng(seed)
    pairs, first = [], 0
    for length in rng.integers(3, 40, 8):
        pairs += [(first + k, first + (k + 1) % length) for k in range(length)]
        pairs += [(first, first + length)]
        first += length
    pairs = np.array(pairs)
    order = order_of(pairs, first + 1)
    assert sorted(order) == list(range(first + 1))
    # a ring of n poses takes n - 3 chords
    assert fill(pairs, order) == first - 3 * 8


@pytest.mark.parametrize('n', [300, FEW + 2])
def test_crowded_nodes_are_left_to_the_ordering(n):
    spokes = np.array([(0, k) for k in range(1, n)])
    order = order_of(spokes, n)
    assert sorted(order) == list(range(n))
    assert fill(spokes, order) == 0


def test_bits_and_lists_order_about_equally_well():
    rng = np.random.default_rng(0)
    n = 1000
    chain = [(k, k + 1) for k in range(n - 1)]
    pairs = np.array(chain + [sorted(rng.integers(0, n, 2)) for _ in range(n // 2)])
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    bits = fill(pairs, order_of(pairs, n))
    lists = fill(pairs, order_by_lists(pairs, n))
    # both take the minimum degree; what is left is by chance
    assert 0.8 < bits / lists < 1.25
