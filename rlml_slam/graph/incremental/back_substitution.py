# SPDX-License-Identifier: Apache-2.0
"""Back-substitution down the clique tree, as far as the update exceeds the wildfire threshold.

With L^T d = -y the cost that is lost where the own variables of a clique are not updated after its
separator moved by D is |L21^T D|^2, at most the sum of h D^2 over the separator with the
information h of all factors on a variable. So a clique is updated when some variable of its
separator moved by more than a small share of its standard deviation 1 / sqrt(h) since the last
time (the wildfire threshold of iSAM2, in sigmas).

The functions that run once per clique take the few arrays that they need: all of the state in
every call would cost as much as the work.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import fetch, part
from rlml_slam.graph.incremental.relinearization_test import needs_test
from rlml_slam.graph.incremental.solver_state import LINE, STEP, Problem, State
from rlml_slam.graph.sparse.symbolic_analysis import Ints, Records
from rlml_slam.se2 import Array, wrapped_by_turns


class Pool(NamedTuple):
    """The pool of the cliques' blocks, as floating-point numbers and as integers."""

    values: Array
    numbers: Ints


@part
def back_substitute(
    state: State, pool: Pool, of_front: Ints, problem: Problem, to_test: Ints
) -> tuple[int, int, int]:
    """Solve the new cliques and those below whose separator moved; numbers of unknowns.

    These are of those solved, of those that moved by more than the wildfire threshold, and of
    those of the latter whose factors have to be tested, with which ``to_test`` is filled.
    """
    unknowns, cliques, step = state.unknowns, state.cliques, state.counts[STEP]
    solved, moved, num, most = 0, 0, 0, 1
    for s in range(len(of_front)):
        if of_front[s] >= 0:
            most = max(most, cliques[of_front[s]]['height'])
    work = np.empty(2 * most + 64)
    stack = np.empty(64, np.int64)
    # the new ones, which have this step's mark: parents come after their children
    for s in range(len(of_front) - 1, -1, -1):
        c = of_front[s]
        depth = 0
        while c >= 0:
            clique = cliques[c]
            if clique['height'] > len(work):
                work = np.empty(2 * clique['height'])
            # prefetch the first child while this one is solved
            child = clique['child']
            if child >= 0:
                _prefetch_block(cliques[child], cliques, pool.numbers)
            some, num = _solve(unknowns, clique, step, pool, problem, to_test, num, work)
            moved += some
            solved += clique['own']
            while child >= 0:
                below = cliques[child]
                if below['mark'] != step and _separator_moved(unknowns, below, pool.numbers, step):
                    if depth == len(stack):
                        more = np.empty(2 * depth, np.int64)
                        more[:depth] = stack
                        stack = more
                    stack[depth] = child
                    depth += 1
                child = below['next']
            c = -1
            if depth > 0:
                depth -= 1
                c = stack[depth]
    return solved, moved, num


@part
def _prefetch_block(clique: np.void, cliques: Records, numbers: Ints) -> None:
    """Prefetch the first lines of a clique's block, and the record of the clique below."""
    fetch(cliques, clique['child'], 0)
    for k in range(0, 4 * LINE, LINE):
        fetch(numbers, clique['block'], k)


@part
def _separator_moved(unknowns: Records, clique: np.void, numbers: Ints, step: int) -> bool:
    """Whether a variable of the separator has moved in this step."""
    first = clique['block']
    for p in range(first + clique['own'], first + clique['members']):
        if unknowns[numbers[p]]['moved'] == step:
            return True
    return False


@part
def _solve(
    unknowns: Records, clique: np.void, step: int, memory: Pool, problem: Problem, to_test: Ints,
    num: int, x: Array,
) -> tuple[int, int]:  # fmt: skip
    """Update the own variables of a clique; how many moved, and how many ``to_test`` has then."""
    pool, numbers = memory.values, memory.numbers
    poses, landmarks = problem.poses, problem.landmarks
    width, height = clique['width'], clique['height']
    first = clique['block']
    at, tall = first + clique['members'], height + 1
    # a tree that is larger than the cache waits for memory longer than it computes
    for k in range(at, at + width * tall, 8):
        fetch(pool, k, 0)
    for p in range(first, first + clique['own']):
        fetch(unknowns, numbers[p], 0)
        fetch(unknowns, numbers[p], LINE)
    w = width
    for p in range(first + clique['own'], first + clique['members']):
        u = unknowns[numbers[p]]
        x[w], x[w + 1] = u['dx'], u['dy']
        if u['size'] == 3:
            x[w + 2] = u['dtheta']
        w += u['size']
    for j in range(width - 1, -1, -1):
        a = at + j * tall
        # four partial sums: a chain of additions would wait for each one
        t0, t1, t2, t3 = -pool[a + height], 0.0, 0.0, 0.0
        i = j + 1
        while i + 3 < height:
            t0 -= pool[a + i] * x[i]
            t1 -= pool[a + i + 1] * x[i + 1]
            t2 -= pool[a + i + 2] * x[i + 2]
            t3 -= pool[a + i + 3] * x[i + 3]
            i += 4
        while i < height:
            t0 -= pool[a + i] * x[i]
            i += 1
        x[j] = ((t0 + t1) + (t2 + t3)) / pool[a + j]
    w, moved, wildfire = 0, 0, problem.thresholds.wildfire
    for p in range(first, first + clique['own']):
        v = numbers[p]
        u = unknowns[v]
        u['dx'], u['dy'] = x[w], x[w + 1]
        sx, sy, st = x[w] - u['sx'], x[w + 1] - u['sy'], 0.0
        k = u['index']
        if u['size'] == 3:
            u['dtheta'] = x[w + 2]
            st = x[w + 2] - u['stheta']
            poses[k, 0], poses[k, 1] = u['x'] + u['dx'], u['y'] + u['dy']
            poses[k, 2] = wrapped_by_turns(u['theta'] + u['dtheta'])
        else:
            landmarks[k, 0], landmarks[k, 1] = u['x'] + u['dx'], u['y'] + u['dy']
        w += u['size']
        sigmas2 = (sx * sx + sy * sy) * u['position_info'] + st * st * u['heading_info']
        if sigmas2 > wildfire * wildfire:
            u['sx'], u['sy'], u['stheta'] = u['dx'], u['dy'], u['dtheta']
            u['moved'] = step
            moved += 1
            if problem.robust or needs_test(u):
                to_test[num] = v
                num += 1
    return moved, num
