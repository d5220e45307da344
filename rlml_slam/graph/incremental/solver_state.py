# SPDX-License-Identifier: Apache-2.0
"""State of the incremental solver: unknowns, linearized factors, the clique tree, and its memory.

The Cholesky factor is a tree of cliques (the Bayes tree of Kaess et al., "iSAM2: Incremental
smoothing and mapping using the Bayes tree", IJRR 31 (2012)): fronts as in sparse/, each with its
panel and its update matrix, linked instead of listed, so that a part can be replaced.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.sparse.symbolic_analysis import Ints, Records
from rlml_slam.se2 import Array

# bytes of a line of the cache; records are whole ones, so that few have to be waited for
LINE = 64

# An unknown pose or landmark (``size`` 3 or 2) at ``index`` of its table. The estimate is x, y,
# theta + d; ``s`` is the d that the cliques below were solved with; ``moved`` is the last step
# that moved it. ``position_info`` [1/m^2] and ``heading_info`` [1/rad^2] bound the information on
# it of all factors. While the heading is between ``valid_low`` and ``valid_high`` the linear
# models of the factors from a pose hold. It is an own variable of ``clique`` (-1: of none);
# ``head`` starts its chain of factor ends, 2 * factor + end, and ``links`` counts them. ``local``
# is its number in the affected part, -1 outside of it; ``affected`` and ``last_change`` are the
# last steps that eliminated it again and that brought a factor to it. In the chain of a pose the
# factors from it come first, in that of a landmark those on it alone.
UNKNOWN = np.dtype(
    # two lines that the back-substitution reads, and one that it does not
    [('size', np.int64), ('moved', np.int64)]
    + [(k, np.float64) for k in ('dx', 'dy', 'dtheta', 'x', 'y', 'theta')]
    + [(k, np.float64) for k in ('sx', 'sy', 'stheta', 'position_info', 'heading_info')]
    + [(k, np.float64) for k in ('valid_low', 'valid_high')]
    + [(k, np.int64) for k in ('index', 'head', 'clique', 'links', 'local')]
    + [(k, np.int64) for k in ('affected', 'last_change')]
    + [('unused', np.int64, 2)]
)

# A factor of any table, in the form of an edge from i to j with unknowns a and b (-1: none): a
# sighting has no information on the angle, a prior has no i. c to theta and I00 to I22 as in
# packed_system.EDGE. Its linearization: ``from`` theta_i, ``C`` and ``S`` cosine and sine of its
# axes, dx and dy t_j - t_i, the robust weight; ``valid_turn`` is the turn of its pose [rad] up to
# which the linear model holds. ``tested`` is the last step that tested it, ``after`` the next one
# to be assembled.
FACTOR = np.dtype(
    # what the relinearization test reads comes first
    [('next_a', np.int64), ('next_b', np.int64)]
    + [(k, np.float64) for k in ('from', 'valid_turn', 'weight')]
    + [(k, np.int32) for k in ('a', 'b', 'i', 'j', 'table', 'kind')]
    + [(k, np.float64) for k in ('C', 'S', 'dx', 'dy', 'I00', 'I01', 'I11')]
    + [('tested', np.int32), ('after', np.int32)]
    + [(k, np.float64) for k in ('c', 's', 'x', 'y', 'theta', 'I02', 'I12', 'I22')]
)
FACTOR_BYTES = FACTOR.itemsize
EDGES, SIGHTINGS, POSE_PRIORS, LANDMARK_PRIORS = 0, 1, 2, 3

# A clique: its place in the tree (-1: none), ``own`` of its ``members`` variables, ``width`` own
# of ``height`` rows. At ``block`` of the pool lie the members, as integers, then the panel, of
# ``width`` columns of ``height`` + 1 rows, of which the last is the right-hand side, then the
# update matrix of ``height`` - ``width`` + 1 rows (refactorization.py). ``size_class`` is that of
# the block, ``mark`` the step that made or dropped it.
CLIQUE = np.dtype(
    [(k, np.int64) for k in ('block', 'size_class', 'own', 'members', 'width', 'height')]
    + [(k, np.int32) for k in ('child', 'next', 'parent', 'mark')]
)

# indices of State.counts: what is known of the graph's tables (poses, landmarks, rows of the four
# tables), what is in use here, the number of the step, where the lists of free records start, the
# elements of the blocks in use, and of those when the tree was ordered as a whole
POSES, LANDMARKS, ROWS, UNKNOWNS, FACTORS, CLIQUES = 0, 1, 2, 6, 7, 8
FIXED_POSES, FIXED_LANDMARKS = 4, 5  # indices of State.on, after those of the tables
FREE_CLIQUE, TOP, STEP, SEEDS, STALE, FREE_UNKNOWN = range(9, 15)
FREE_FACTOR, IN_USE, IN_USE_AT_ORDERING, COUNTS = range(15, 19)

CLASSES = 256  # size classes of blocks: four to an octave
LITTLE = 1 << 14  # elements [128 kB] below which memory is not compacted


class State(NamedTuple):
    """All but the pool of numbers, which grows in the kernels.

    ``of_pose`` and ``of_landmark`` are the unknowns of the nodes (-1: fixed), ``of_row`` (4, k)
    and ``on`` (6, k) the factor of each row of the tables and whether it is enabled; the last two
    of ``on`` are the flags of the fixed poses and landmarks. ``seeds`` are the unknowns whose
    cliques have to be replaced, ``stale`` the factors to be relinearized. ``free`` starts the
    list of free blocks of each class.
    """

    unknowns: Records
    factors: Records
    cliques: Records
    of_pose: Ints
    of_landmark: Ints
    of_row: Ints
    on: NDArray[np.bool_]
    seeds: Ints
    stale: Ints
    free: Ints
    counts: Ints


class Thresholds(NamedTuple):
    """Thresholds of relinearization and of back-substitution.

    A factor is relinearized when its linear model is off by ``linear`` standard deviations, its
    axes have turned by ``turn`` [rad] or its robust weight changed by that share, else only where
    it has to be assembled anyway. A move of a variable by less than ``wildfire`` standard
    deviations is not passed on to the cliques below (the wildfire threshold of iSAM2).
    """

    linear: float = 0.05
    turn: float = 0.1
    wildfire: float = 0.02


class Problem(NamedTuple):
    """What is minimised: the estimate, the losses (7, 2), whether any is robust, thresholds."""

    poses: Array
    landmarks: Array
    losses: Array
    robust: bool
    thresholds: Thresholds


def new_state(poses: int, landmarks: int, rows: int, factors: int) -> State:
    """An empty state with room for so many nodes, rows in a table and factors in all."""
    nodes = poses + landmarks
    count = np.zeros(COUNTS, np.int64)
    count[FREE_CLIQUE] = count[FREE_UNKNOWN] = count[FREE_FACTOR] = -1
    return State(
        _records(nodes, UNKNOWN), _records(factors, FACTOR), _records(nodes + 1, CLIQUE),
        np.full(poses, -1), np.full(landmarks, -1), np.full((4, rows), -1),
        np.zeros((6, max(rows, poses, landmarks)), np.bool_), np.zeros(nodes, np.int64),
        np.zeros(factors, np.int64), np.full(CLASSES, -1), count,
    )  # fmt: skip


def _records(num: int, kind: np.dtype[np.void]) -> Records:
    """That many records of zeros that begin with a line of the cache."""
    memory = np.zeros(num * kind.itemsize + LINE, np.uint8)
    first = -memory.ctypes.data % LINE
    return memory[first : first + num * kind.itemsize].view(kind)


def grown_state(state: State, poses: int, landmarks: int, rows: int, factors: int) -> State:
    """The state with more room."""
    new = new_state(poses, landmarks, rows, factors)
    for old, to in zip(state, new, strict=True):
        to[tuple(slice(n) for n in old.shape)] = old
    return new


@part
def size_class_of(size: int) -> tuple[int, int]:
    """(size class, elements) of the smallest block that holds ``size`` elements."""
    octave, least = 0, 16
    while 2 * least <= size:
        least *= 2
        octave += 1
    step = least // 4
    quarter = max(0, (size - least + step - 1) // step)
    return 4 * octave + quarter, least + quarter * step


@part
def allocate_block(free: Ints, count: Ints, numbers: Ints, size_class: int, elements: int) -> int:
    """Index of a block of a size class; ``numbers`` is the pool seen as integers."""
    at: int = free[size_class]
    if at >= 0:
        free[size_class] = numbers[at]
    else:
        at = count[TOP]
        count[TOP] += elements
    return at


@part
def ensure_capacity(pool: Array, top: int, need: int) -> Array:
    """The pool, or a copy of it that holds ``need`` more elements above ``top``."""
    if top + need <= len(pool):
        return pool
    more = np.empty((top + need) * 5 // 4)
    for k in range(top):
        more[k] = pool[k]
    return more


@part
def elements_of_class(size_class: int) -> int:
    """Elements of a block of a class."""
    least = 16 << (size_class // 4)
    return int(least + size_class % 4 * (least // 4))


@kernel
def compacted(state: State, pool: Array) -> Array:
    """A pool of the blocks in use, one after the other, and a quarter more."""
    cliques = state.cliques
    more = np.empty(state.counts[IN_USE] * 5 // 4 + LITTLE)
    moved = np.zeros(state.counts[CLIQUES], np.bool_)
    top = 0
    for v in range(state.counts[UNKNOWNS]):
        c = state.unknowns[v]['clique']
        if c < 0 or moved[c]:
            continue
        moved[c] = True
        first, elements = cliques[c]['block'], elements_of_class(cliques[c]['size_class'])
        for k in range(elements):
            more[top + k] = pool[first + k]
        cliques[c]['block'] = top
        top += elements
    state.counts[TOP] = top
    for k in range(len(state.free)):
        state.free[k] = -1
    return more


@part
def allocate_clique(cliques: Records, count: Ints) -> int:
    """A record for a clique."""
    c: int = count[FREE_CLIQUE]
    if c >= 0:
        count[FREE_CLIQUE] = cliques[c]['next']
    else:
        c = count[CLIQUES]
        count[CLIQUES] += 1
    return c


@part
def allocate_unknown(unknowns: Records, count: Ints) -> int:
    """A record for an unknown; the free ones are linked by ``head``."""
    v: int = count[FREE_UNKNOWN]
    if v >= 0:
        count[FREE_UNKNOWN] = unknowns[v]['head']
    else:
        v = count[UNKNOWNS]
        count[UNKNOWNS] += 1
    return v


@part
def allocate_factor(factors: Records, count: Ints) -> int:
    """A record for a factor; the free ones are linked by ``after``."""
    f: int = count[FREE_FACTOR]
    if f >= 0:
        count[FREE_FACTOR] = factors[f]['after']
    else:
        f = count[FACTORS]
        count[FACTORS] += 1
    return f


@part
def free_clique(state: State, numbers: Ints, c: int) -> None:
    """Free a clique and its block."""
    clique = state.cliques[c]
    state.counts[IN_USE] -= elements_of_class(clique['size_class'])
    numbers[clique['block']] = state.free[clique['size_class']]
    state.free[clique['size_class']] = clique['block']
    clique['next'] = state.counts[FREE_CLIQUE]
    state.counts[FREE_CLIQUE] = c


@part
def attach_clique(cliques: Records, c: int, parent: int) -> None:
    """Link clique c below ``parent`` (-1: a root)."""
    cliques[c]['parent'] = parent
    cliques[c]['next'] = -1
    if parent >= 0:
        cliques[c]['next'] = cliques[parent]['child']
        cliques[parent]['child'] = c


@part
def mark_affected(state: State, v: int) -> None:
    """The clique of unknown v has to be replaced in this step."""
    if v >= 0 and state.unknowns[v]['affected'] != state.counts[STEP]:
        state.unknowns[v]['affected'] = state.counts[STEP]
        state.seeds[state.counts[SEEDS]] = v
        state.counts[SEEDS] += 1
