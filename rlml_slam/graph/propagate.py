# SPDX-License-Identifier: Apache-2.0
"""Back-substitution down the tree, as far as it matters.

With L^T d = -y the cost that is lost where the own variables of a clique are not updated after its
separator moved by D is |L21^T D|^2, at most the sum of h D^2 over the separator with the
information h of all factors on a variable. So a clique is updated when some variable of its
separator moved by more than a small share of its standard deviation 1 / sqrt(h) since the last
time (the wildfire threshold of iSAM2, in sigmas).
"""

from __future__ import annotations

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.graph.increments import STEP, State
from rlml_slam.graph.linearize import wrapped
from rlml_slam.graph.structure import Ints
from rlml_slam.se2 import Array


@part
def propagate(
    state: State, pool: Array, numbers: Ints, of_front: Ints, poses: Array, landmarks: Array,
    still: float, moved: Ints,
) -> tuple[int, int]:  # fmt: skip
    """Solve the new cliques and those below that feel it; (moved, solved) numbers of unknowns.

    ``moved`` is filled with the unknowns that moved by more than ``still`` sigmas.
    """
    cliques, step = state.cliques, state.counts[STEP]
    num, solved, most = 0, 0, 1
    for s in range(len(of_front)):
        if of_front[s] >= 0:
            most = max(most, cliques[of_front[s]]['height'])
    work = np.empty(2 * most + 64)
    stack = np.empty(64, np.int64)
    depth = 0
    # the new ones, which bear this step's mark: parents come after their children
    for s in range(len(of_front) - 1, -1, -1):
        c = of_front[s]
        if c < 0:
            continue
        num = _solve(state, pool, numbers, c, poses, landmarks, still, moved, num, work)
        solved += cliques[c]['own']
        child = cliques[c]['child']
        while True:
            while child >= 0:
                if cliques[child]['mark'] != step and _feels(state, numbers, child):
                    if depth == len(stack):
                        more = np.empty(2 * depth, np.int64)
                        more[:depth] = stack
                        stack = more
                    stack[depth] = child
                    depth += 1
                child = cliques[child]['next']
            if depth == 0:
                break
            depth -= 1
            c = stack[depth]
            if cliques[c]['height'] > len(work):
                work = np.empty(2 * cliques[c]['height'])
            num = _solve(state, pool, numbers, c, poses, landmarks, still, moved, num, work)
            solved += cliques[c]['own']
            child = cliques[c]['child']
    return num, solved


@part
def _feels(state: State, numbers: Ints, c: int) -> bool:
    """Whether a variable of the separator has moved in this step."""
    clique, step = state.cliques[c], state.counts[STEP]
    first = clique['block']
    for p in range(first + clique['own'], first + clique['members']):
        if state.unknowns[numbers[p]]['moved'] == step:
            return True
    return False


@part
def _solve(
    state: State, pool: Array, numbers: Ints, c: int, poses: Array, landmarks: Array,
    still: float, moved: Ints, num: int, x: Array,
) -> int:  # fmt: skip
    """Update the own variables of clique c; the number of moved unknowns so far."""
    clique, unknowns = state.cliques[c], state.unknowns
    at, width, height = clique['panel'], clique['width'], clique['height']
    tall = height + 1
    first = clique['block']
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
    w = 0
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
            poses[k, 2] = wrapped(u['theta'] + u['dtheta'])
        else:
            landmarks[k, 0], landmarks[k, 1] = u['x'] + u['dx'], u['y'] + u['dy']
        w += u['size']
        if (sx * sx + sy * sy) * u['stiff'] + st * st * u['turn'] > still * still:
            u['sx'], u['sy'], u['stheta'] = u['dx'], u['dy'], u['dtheta']
            u['moved'] = state.counts[STEP]
            moved[num] = v
            num += 1
    return num
