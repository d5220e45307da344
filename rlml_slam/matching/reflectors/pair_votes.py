# SPDX-License-Identifier: Apache-2.0
"""Poses at which pairs of detections fall on pairs of reflectors, with their numbers of matches.

A pose is proposed by every pair of detections for every pair of reflectors as far apart. Matches
that agree with each other are proposed by the widest pair of them, too. So a pair is tested only
with the detections that lie no farther from either of the two than these from each other: there,
the heading of the pair is good enough, and no agreeing set is lost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array, wrapped_by_turns

MIN_MATCHES = 3  # two matches and their mirror image fit anywhere
SLACK = 4  # poses with this many matches fewer than the best are kept
CAPACITY = 20000  # of the proposals kept; the ones with fewest matches go first
MAX_CELLS = 256  # per side of the buckets
MAX_PAIRS = 10_000_000  # of reflectors: as many take 300 MB
# Pairs of reflectors, and others near detections at them, that a search looks at: half a second
# of it. Sixty detections are found with less among four thousand reflectors.
MAX_TESTS = 100_000_000
Ints = NDArray[np.int64]


class Buckets(NamedTuple):
    """Cells of a grid with the reflectors that a point in the cell may be gated with."""

    starts: Ints  # (cells + 1,) into members
    members: Ints
    corner: Array  # (2,) [m]
    cell: float  # [m]
    columns: int
    rows: int


class Pairs(NamedTuple):
    """Pairs (first, second) of reflectors by ``length`` [m], ascending."""

    length: Array
    first: Ints
    second: Ints


def pairs_of(points: Array, reach: float) -> Pairs | None:
    """All pairs of points (m, 2) within ``reach`` of each other; None where there are too many."""
    tree = cKDTree(points)
    if tree.count_neighbors(tree, reach) > 2 * MAX_PAIRS:
        return None
    pairs = tree.query_pairs(reach, output_type='ndarray')
    first, second = pairs[np.argsort(pairs[:, 0] * len(points) + pairs[:, 1])].T
    length = np.hypot(*(points[second] - points[first]).T)
    order = np.argsort(length, kind='stable')
    return Pairs(length[order], first[order], second[order])


def buckets_of(points: Array, reach: float) -> Buckets:
    """Buckets in which every point of the plane finds the reflectors (m, 2) within ``reach``."""
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    cell = max(reach, float((high - low).max()) / MAX_CELLS)
    columns, rows = (int(n) + 1 for n in (high - low) / cell)
    starts, members = _fill(points, reach, low, cell, columns, rows)
    return Buckets(starts, members, low, cell, columns, rows)


@kernel
def _fill(
    points: Array, reach: float, corner: Array, cell: float, columns: int, rows: int
) -> tuple[Ints, Ints]:
    starts = np.zeros(columns * rows + 1, np.int64)
    members = np.zeros(0, np.int64)
    for filling in range(2):
        for k in range(len(points)):
            x, y = points[k, 0] - corner[0], points[k, 1] - corner[1]
            for v in range(
                max(int((y - reach) / cell), 0), min(int((y + reach) / cell) + 1, rows)
            ):
                for u in range(
                    max(int((x - reach) / cell), 0), min(int((x + reach) / cell) + 1, columns)
                ):
                    c = v * columns + u
                    if filling:
                        starts[c] -= 1
                        members[starts[c]] = k
                    else:
                        starts[c] += 1
        if not filling:
            for c in range(columns * rows):
                starts[c + 1] += starts[c]
            members = np.zeros(starts[-1], np.int64)
    return starts, members


@part
def cell_of(x: float, y: float, b: Buckets) -> int:
    """The cell of a point, -1 outside of all."""
    u, v = math.floor((x - b.corner[0]) / b.cell), math.floor((y - b.corner[1]) / b.cell)
    if u < 0 or v < 0 or u >= b.columns or v >= b.rows:
        return -1
    return int(v * b.columns + u)


@part
def _bisect(ascending: Array, value: float) -> int:
    """How many are less than a value."""
    low, high = 0, len(ascending)
    while low < high:
        middle = (low + high) // 2
        if ascending[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


class Measured(NamedTuple):
    """Points (n, 2) with covariances (n, 2, 2) and variances (n,) of their worst directions."""

    points: Array
    cov: Array
    var: Array


class PosePrior(NamedTuple):
    """A pose (3,) with its information (3, 3), zeros for none, and the gate of its distance."""

    pose: Array
    information: Array
    gate2: float


class Proposal(NamedTuple):
    """A pose by a pair of matches: heading (cos, sin) and (x, y).

    The variances are of the point of the detections that does not move with the heading, and of
    the heading.
    """

    number: int
    cos: float
    sin: float
    x: float
    y: float
    fixed_x: float
    fixed_y: float
    var_fixed: float
    var_turn: float


class Votes(NamedTuple):
    """``counts`` (h,) of matches and ``bases`` (h, 4), detections a, b and their reflectors.

    ``proposals`` is how many there were at all, ``searched`` whether these are all.
    """

    counts: Ints
    bases: Ints
    proposals: int
    searched: bool


@kernel
def vote(
    seen: Measured, known: Measured, pairs: Pairs, buckets: Buckets, gate2: float,
    prior: PosePrior, max_tests: int,
) -> Votes:  # fmt: skip
    """Proposals with at least MIN_MATCHES matches and not over SLACK fewer than the best.

    A pose must lie within the gate of the prior. After ``max_tests`` the search ends.
    """
    z, z_var, p, p_var = seen.points, seen.var, known.points, known.var
    k, m = len(z), len(p)
    g = math.sqrt(gate2)
    widest_var = 0.0
    for i in range(m):
        widest_var = max(widest_var, p_var[i])
    counts = np.zeros(CAPACITY, np.int64)
    bases = np.zeros((CAPACITY, 4), np.int64)
    kept, proposals, best, need, stamp = 0, 0, 0, MIN_MATCHES, 0
    taken, lens = np.zeros(m, np.int64), np.zeros(k, np.int64)
    tests = 0
    for a in range(k):
        for b in range(a + 1, k):
            if tests > max_tests:
                return Votes(counts[:0], bases[:0], proposals, False)
            dx, dy = z[b, 0] - z[a, 0], z[b, 1] - z[a, 1]
            length = math.hypot(dx, dy)
            tolerance = g * math.sqrt(z_var[a] + z_var[b] + 2.0 * widest_var)
            if length <= 2.0 * tolerance:
                continue  # too short a baseline to determine the heading
            low = _bisect(pairs.length, length - tolerance)
            high = _bisect(pairs.length, length + tolerance)
            if low == high:
                continue
            inside = _within(z, a, b, length, lens)
            tests += k + 2 * (high - low)
            for q in range(2 * low, 2 * high):
                i, j = pairs.first[q // 2], pairs.second[q // 2]
                if q % 2 == 1:
                    i, j = j, i
                var_a, var_b = z_var[a] + p_var[i], z_var[b] + p_var[j]
                both = var_a + var_b
                l_map = pairs.length[q // 2]
                if (l_map - length) ** 2 > gate2 * both:
                    continue
                ex, ey = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
                cos = (dx * ex + dy * ey) / (length * l_map)
                sin = (dx * ey - dy * ex) / (length * l_map)
                # the fixed point of the two: their mean, the better known one counting more
                share = var_a / both
                mx, my = z[a, 0] + share * dx, z[a, 1] + share * dy
                nx, ny = p[i, 0] + share * ex, p[i, 1] + share * ey
                tx, ty = nx - cos * mx + sin * my, ny - sin * mx - cos * my
                if _distance2(prior, tx, ty, cos, sin) > prior.gate2:
                    continue
                proposals += 1
                if 2 + inside < need:
                    continue
                stamp += 1
                taken[i] = taken[j] = stamp
                proposal = Proposal(
                    stamp, cos, sin, tx, ty, mx, my, var_a * var_b / both, both / (length * length)
                )
                count, tested = _count(
                    seen, known, buckets, lens[:inside], proposal, gate2, need, taken
                )
                tests += tested
                if count < need:
                    continue
                if count > best:
                    best = count
                    need = max(need, best - SLACK)
                while kept == CAPACITY:
                    kept = _drop(counts, bases, kept, need)
                    if kept == CAPACITY:
                        need += 1
                counts[kept] = count
                bases[kept, 0], bases[kept, 1] = a, b
                bases[kept, 2], bases[kept, 3] = i, j
                kept += 1
    kept = _drop(counts, bases, kept, need)
    return Votes(counts[:kept], bases[:kept], proposals, True)


@part
def _distance2(prior: PosePrior, x: float, y: float, cos: float, sin: float) -> float:
    """Squared Mahalanobis distance of a pose from the prior, 0 without one."""
    information = prior.information
    if information[2, 2] <= 0.0:
        return 0.0
    ux, uy = x - prior.pose[0], y - prior.pose[1]
    ut = wrapped_by_turns(math.atan2(sin, cos) - prior.pose[2])
    return float(
        information[0, 0] * ux * ux + information[1, 1] * uy * uy
        + information[2, 2] * ut * ut + 2.0 * information[0, 1] * ux * uy
        + 2.0 * (information[0, 2] * ux + information[1, 2] * uy) * ut
    )  # fmt: skip


@part
def _count(
    seen: Measured, known: Measured, buckets: Buckets, others: Ints, pose: Proposal, gate2: float,
    need: int, taken: Ints,
) -> tuple[int, int]:  # fmt: skip
    """How many detections match at a pose, the pair included, and how many tests that took.

    Of the ``others``; once there cannot be ``need`` any more, it ends. ``taken`` (m,) has the
    number of the last pose at which each reflector was matched.
    """
    z, p = seen.points, known.points
    count, tests = 2, 0
    for n in range(len(others)):
        if count + len(others) - n < need:
            break
        tests += 1
        c = others[n]
        x = pose.x + pose.cos * z[c, 0] - pose.sin * z[c, 1]
        y = pose.y + pose.sin * z[c, 0] + pose.cos * z[c, 1]
        cell = cell_of(x, y, buckets)
        if cell < 0:
            continue
        arm2 = (z[c, 0] - pose.fixed_x) ** 2 + (z[c, 1] - pose.fixed_y) ** 2
        var = seen.var[c] + pose.var_fixed + arm2 * pose.var_turn
        nearest, least = -1, math.inf
        begin, end = buckets.starts[cell], buckets.starts[cell + 1]
        tests += end - begin
        for s in range(begin, end):
            r = buckets.members[s]
            d2 = ((x - p[r, 0]) ** 2 + (y - p[r, 1]) ** 2) / (var + known.var[r])
            if d2 <= gate2 and d2 < least:
                nearest, least = r, d2
        if nearest >= 0 and taken[nearest] != pose.number:
            taken[nearest] = pose.number
            count += 1
    return count, tests


@part
def _within(z: Array, a: int, b: int, length: float, lens: Ints) -> int:
    """Detections no farther from a and b than ``length`` into ``lens``; how many there are."""
    inside = 0
    for c in range(len(z)):
        if c in (a, b):
            continue
        near_a = math.hypot(z[c, 0] - z[a, 0], z[c, 1] - z[a, 1]) <= length
        if near_a and math.hypot(z[c, 0] - z[b, 0], z[c, 1] - z[b, 1]) <= length:
            lens[inside] = c
            inside += 1
    return inside


@part
def _drop(counts: Ints, bases: Ints, num: int, need: int) -> int:
    """Keep those of the first ``num`` proposals that have ``need`` matches; how many these are."""
    kept = 0
    for n in range(num):
        if counts[n] >= need:
            counts[kept] = counts[n]
            for i in range(4):
                bases[kept, i] = bases[n, i]
            kept += 1
    return kept
