# SPDX-License-Identifier: Apache-2.0
import numba
import numpy as np
import pytest
from numba_modules import compiled_by_numba

bitset, analysis = compiled_by_numba('bitset_minimum_degree', 'symbolic_analysis')
minimum_degree_of_bits, adjacency = bitset.minimum_degree_of_bits, analysis.adjacency


@numba.njit
def order_of(pairs, num):
    start, neighbours = adjacency(pairs, num)
    return minimum_degree_of_bits(start, neighbours)


def with_landmarks(rng, poses, landmarks):
    """A chain of poses, each of which sees four landmarks."""
    pairs = [(k, k + 1) for k in range(poses - 1)]
    for k in range(poses):
        seen = rng.choice(landmarks, 4, replace=False)
        pairs += [(k, poses + int(m)) for m in seen]
    return np.array(pairs), poses + landmarks


def scattered(rng, num):
    return np.array([rng.choice(num, 2, replace=False) for _ in range(2 * num)]), num


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('kind', ['landmarks', 'scattered'])
def test_no_node_has_a_smaller_degree_than_the_next_pivot(seed, kind):
    rng = np.random.default_rng(seed)
    # one word, a whole number of words, and more
    size = (40, 64, 129, 200)[seed]
    pairs, n = with_landmarks(rng, size - 15, 15) if kind == 'landmarks' else scattered(rng, size)
    order = order_of(pairs, n)
    assert sorted(order) == list(range(n))
    closed = {i: {i} for i in range(n)}
    for i, j in pairs.tolist():
        closed[i].add(j)
        closed[j].add(i)
    for v in order.tolist():
        around = closed.pop(v)
        twins = sum(closed[i] == around for i in around - {v})
        assert len(around) - 1 - twins <= min((len(c) - 1 for c in closed.values()), default=0)
        for i in around - {v}:
            closed[i] = (closed[i] | around) - {v}


def test_twins_are_eliminated_together():
    # 70 nodes that touch the same 80, which touch nothing else: twins once the first of these went
    pairs = np.array([(k, 70 + m) for k in range(70) for m in range(80)])
    order = order_of(pairs, 150)
    assert sorted(order) == list(range(150))
    at = np.flatnonzero(order < 70)
    assert at[-1] - at[0] == 69


@pytest.mark.parametrize('n', [0, 1, 64, 65])
def test_nodes_without_neighbours_have_an_order(n):
    assert order_of(np.zeros((0, 2), np.int64), n).tolist() == list(range(n))
