# SPDX-License-Identifier: Apache-2.0
"""Poses at which pairs of detections fall on pairs of reflectors, counted and refined.

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
from rlml_slam.se2 import Array

MIN_MATCHES = 3  # two matches and their mirror image fit anywhere
SLACK = 4  # poses with this many matches fewer than the best are kept
CAPACITY = 20000  # of the proposals kept; the ones with fewest matches go first
LOOSE = 4.0  # a match waits while the pose's variance there is this many times the noise
ROUNDS = 12  # of matching and fitting; a pose that still changes is taken as it is
MAX_CELLS = 256  # per side of the buckets
MAX_PAIRS = 10_000_000  # of reflectors: as many take 300 MB
# Pairs of reflectors, and others near detections at them, that a search looks at: half a second
# of it. Sixty detections are found with less among four thousand reflectors.
MAX_TESTS = 100_000_000


class Buckets(NamedTuple):
    """Cells of a grid with the reflectors that a point in the cell may be gated with."""

    starts: NDArray[np.int64]  # (cells + 1,) into members
    members: NDArray[np.int64]
    corner: Array  # (2,) [m]
    cell: float  # [m]
    columns: int
    rows: int


class Pairs(NamedTuple):
    """Pairs (first, second) of reflectors by ``length`` [m], ascending."""

    length: Array
    first: NDArray[np.int64]
    second: NDArray[np.int64]


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
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
def _cell_of(x: float, y: float, b: Buckets) -> int:
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


@kernel
def vote(
    z: Array,
    z_var: Array,
    p: Array,
    p_var: Array,
    pairs: Pairs,
    buckets: Buckets,
    gate2: float,
    prior: Array,
    information: Array,
    prior_gate2: float,
    max_tests: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], int, bool]:
    """Proposals with at least MIN_MATCHES matches and not over SLACK fewer than the best.

    Detections ``z`` (k, 2) with variances of their worst direction ``z_var`` (k,), reflectors
    ``p`` (m, 2) likewise. A pose must lie within ``prior_gate2`` of ``prior`` (3,) in the squared
    distance of ``information`` (3, 3); zeros are no prior. Returns counts (h,), bases (h, 4) =
    detections a, b and their reflectors, how many proposals there were at all, and whether these
    are all: after ``max_tests`` the search ends.
    """
    k, m = len(z), len(p)
    g = math.sqrt(gate2)
    widest_var = 0.0
    for i in range(m):
        widest_var = max(widest_var, p_var[i])
    counts = np.zeros(CAPACITY, np.int64)
    bases = np.zeros((CAPACITY, 4), np.int64)
    kept, proposals, best, need, stamp = 0, 0, 0, MIN_MATCHES, 0
    taken = np.zeros(m, np.int64)
    lens = np.zeros(k, np.int64)
    tests = 0
    for a in range(k):
        for b in range(a + 1, k):
            if tests > max_tests:
                return counts[:0], bases[:0], proposals, False
            dx, dy = z[b, 0] - z[a, 0], z[b, 1] - z[a, 1]
            length = math.hypot(dx, dy)
            tolerance = g * math.sqrt(z_var[a] + z_var[b] + 2.0 * widest_var)
            if length <= 2.0 * tolerance:
                continue  # too short a baseline to determine the heading
            low = _bisect(pairs.length, length - tolerance)
            high = _bisect(pairs.length, length + tolerance)
            if low == high:
                continue
            inside = 0
            for c in range(k):
                if c in (a, b):
                    continue
                near_a = math.hypot(z[c, 0] - z[a, 0], z[c, 1] - z[a, 1]) <= length
                if near_a and math.hypot(z[c, 0] - z[b, 0], z[c, 1] - z[b, 1]) <= length:
                    lens[inside] = c
                    inside += 1
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
                if information[2, 2] > 0.0:
                    ux, uy = tx - prior[0], ty - prior[1]
                    turn = math.atan2(sin, cos) - prior[2]
                    ut = turn - 2.0 * math.pi * round(turn / (2.0 * math.pi))
                    d2 = (
                        information[0, 0] * ux * ux + information[1, 1] * uy * uy
                        + information[2, 2] * ut * ut + 2.0 * information[0, 1] * ux * uy
                        + 2.0 * (information[0, 2] * ux + information[1, 2] * uy) * ut
                    )  # fmt: skip
                    if d2 > prior_gate2:
                        continue
                proposals += 1
                if 2 + inside < need:
                    continue
                stamp += 1
                taken[i] = taken[j] = stamp
                count = 2
                var_mean = var_a * var_b / both
                var_turn = both / (length * length)
                for n in range(inside):
                    if count + inside - n < need:
                        break
                    tests += 1
                    c = lens[n]
                    x = tx + cos * z[c, 0] - sin * z[c, 1]
                    y = ty + sin * z[c, 0] + cos * z[c, 1]
                    cell = _cell_of(x, y, buckets)
                    if cell < 0:
                        continue
                    arm2 = (z[c, 0] - mx) ** 2 + (z[c, 1] - my) ** 2
                    var = z_var[c] + var_mean + arm2 * var_turn
                    nearest, least = -1, math.inf
                    begin, end = buckets.starts[cell], buckets.starts[cell + 1]
                    tests += end - begin
                    for s in range(begin, end):
                        r = buckets.members[s]
                        d2 = ((x - p[r, 0]) ** 2 + (y - p[r, 1]) ** 2) / (var + p_var[r])
                        if d2 <= gate2 and d2 < least:
                            nearest, least = r, d2
                    if nearest >= 0 and taken[nearest] != stamp:
                        taken[nearest] = stamp
                        count += 1
                if count < need:
                    continue
                if count > best:
                    best = count
                    need = max(need, best - SLACK)
                while kept == CAPACITY:
                    old, kept = kept, 0
                    for n in range(old):
                        if counts[n] >= need:
                            counts[kept] = counts[n]
                            for i in range(4):
                                bases[kept, i] = bases[n, i]
                            kept += 1
                    if kept == CAPACITY:
                        need += 1
                counts[kept] = count
                bases[kept, 0], bases[kept, 1] = a, b
                bases[kept, 2], bases[kept, 3] = i, j
                kept += 1
    chosen = 0
    for n in range(kept):
        if counts[n] >= need:
            counts[chosen] = counts[n]
            for i in range(4):
                bases[chosen, i] = bases[n, i]
            chosen += 1
    return counts[:chosen], bases[:chosen], proposals, True


@kernel
def refine(
    base: NDArray[np.int64],
    z: Array,
    z_cov: Array,
    p: Array,
    p_cov: Array,
    buckets: Buckets,
    gate2: float,
    noise: float,
    prior: Array,
    information: Array,
) -> tuple[Array, Array, NDArray[np.int64], float]:
    """The pose of one proposal, fitted to all detections that match there.

    ``noise`` [m^2] is the largest variance of a match. Returns pose (3,), its cov (3, 3), match
    (k,) (reflector or -1) and the squared Mahalanobis distance of all matches and the prior.
    """
    k = len(z)
    match, before = np.full(k, -1, np.int64), np.zeros(k, np.int64)
    a, b, i, j = base[0], base[1], base[2], base[3]
    dx, dy = z[b, 0] - z[a, 0], z[b, 1] - z[a, 1]
    ex, ey = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
    match[a], match[b] = i, j
    pose = np.zeros(3)
    pose[2] = math.atan2(dx * ey - dy * ex, dx * ex + dy * ey)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    pose[0] = p[i, 0] - c * z[a, 0] + s * z[a, 1]
    pose[1] = p[i, 1] - s * z[a, 0] - c * z[a, 1]
    cov, chi2 = _fit(pose, match, z, z_cov, p, p_cov, prior, information)
    for _ in range(ROUNDS):
        matches, changed = 0, False
        for n in range(k):
            before[n] = match[n]
        _match_all(pose, cov, match, z, z_cov, p, p_cov, buckets, gate2, noise)
        for n in range(k):
            matches += match[n] >= 0
            changed |= match[n] != before[n]
        if matches < 2:
            break
        cov, chi2 = _fit(pose, match, z, z_cov, p, p_cov, prior, information)
        if not changed:
            break
    return pose, cov, match, chi2


@part
def _match_all(
    pose: Array,
    cov: Array,
    match: NDArray[np.int64],
    z: Array,
    z_cov: Array,
    p: Array,
    p_cov: Array,
    buckets: Buckets,
    gate2: float,
    noise: float,
) -> None:
    """Write the nearest reflector inside the gate, one detection for each, or -1 to ``match``."""
    k = len(z)
    owner = np.full(len(p), -1, np.int64)
    distance = np.full(k, np.inf)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for n in range(k):
        match[n] = -1
        rx, ry = c * z[n, 0] - s * z[n, 1], s * z[n, 0] + c * z[n, 1]
        x, y = pose[0] + rx, pose[1] + ry
        cell = _cell_of(x, y, buckets)
        if cell < 0:
            continue
        # of the pose at this point: J cov J^T with J = [1 0 -ry; 0 1 rx]
        xx = cov[0, 0] - 2.0 * ry * cov[0, 2] + ry * ry * cov[2, 2]
        yy = cov[1, 1] + 2.0 * rx * cov[1, 2] + rx * rx * cov[2, 2]
        xy = cov[0, 1] + rx * cov[0, 2] - ry * cov[1, 2] - rx * ry * cov[2, 2]
        if xx + yy > LOOSE * noise:
            continue
        axx, axy, ayy = _turned(z_cov, n, c, s)
        for q in range(buckets.starts[cell], buckets.starts[cell + 1]):
            r = buckets.members[q]
            sxx, sxy = xx + axx + p_cov[r, 0, 0], xy + axy + p_cov[r, 0, 1]
            syy = yy + ayy + p_cov[r, 1, 1]
            u, v = p[r, 0] - x, p[r, 1] - y
            d2 = (syy * u * u - 2.0 * sxy * u * v + sxx * v * v) / (sxx * syy - sxy * sxy)
            if d2 <= gate2 and d2 < distance[n]:
                distance[n] = d2
                match[n] = r
        r = match[n]
        if r >= 0:
            if owner[r] < 0 or distance[n] < distance[owner[r]]:
                if owner[r] >= 0:
                    match[owner[r]] = -1
                owner[r] = n
            else:
                match[n] = -1


@part
def _turned(C: Array, n: int, c: float, s: float) -> tuple[float, float, float]:
    """Entries xx, xy, yy of R C[n] R^T."""
    xx, xy, yy = C[n, 0, 0], C[n, 0, 1], C[n, 1, 1]
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@part
def _fit(
    pose: Array,
    match: NDArray[np.int64],
    z: Array,
    z_cov: Array,
    p: Array,
    p_cov: Array,
    prior: Array,
    information: Array,
) -> tuple[Array, float]:
    """Move ``pose`` to the weighted least squares of its matches and the prior.

    Minimises sum r^T S^-1 r with r = p_j - (t + R z_i), S = R C_i R^T + P_j. Returns the inverse
    of the information and the minimum.
    """
    H, g, d, chi2 = np.zeros((3, 3)), np.zeros(3), np.zeros(3), 0.0
    cov = np.zeros((3, 3))
    for iteration in range(6):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        for i in range(3):
            d[i] = pose[i] - prior[i]
        d[2] -= 2.0 * math.pi * round(d[2] / (2.0 * math.pi))
        chi2 = 0.0
        for i in range(3):
            g[i] = 0.0
            for j in range(3):
                H[i, j] = information[i, j]
                g[i] -= information[i, j] * d[j]
                chi2 += d[i] * information[i, j] * d[j]
        for n in range(len(z)):
            r = match[n]
            if r < 0:
                continue
            rx, ry = c * z[n, 0] - s * z[n, 1], s * z[n, 0] + c * z[n, 1]
            u, v = p[r, 0] - pose[0] - rx, p[r, 1] - pose[1] - ry
            axx, axy, ayy = _turned(z_cov, n, c, s)
            axx, axy, ayy = axx + p_cov[r, 0, 0], axy + p_cov[r, 0, 1], ayy + p_cov[r, 1, 1]
            det = axx * ayy - axy * axy
            wxx, wxy, wyy = ayy / det, -axy / det, axx / det
            chi2 += wxx * u * u + 2.0 * wxy * u * v + wyy * v * v
            # columns of W J for J = [1 0 -ry; 0 1 rx]
            hx, hy = -ry * wxx + rx * wxy, -ry * wxy + rx * wyy
            H[0, 0] += wxx
            H[0, 1] += wxy
            H[1, 1] += wyy
            H[0, 2] += hx
            H[1, 2] += hy
            H[2, 2] += -ry * hx + rx * hy
            g[0] += wxx * u + wxy * v
            g[1] += wxy * u + wyy * v
            g[2] += hx * u + hy * v
        _invert(H, cov)
        if iteration == 5:
            break
        largest = 0.0
        for i in range(3):
            step = cov[i, 0] * g[0] + cov[i, 1] * g[1] + cov[i, 2] * g[2]
            pose[i] += step
            largest = max(largest, step * step / cov[i, i])
        if largest < 1e-16:
            break
    pose[2] -= 2.0 * math.pi * math.ceil((pose[2] - math.pi) / (2.0 * math.pi))
    return cov, chi2


@part
def _invert(H: Array, out: Array) -> None:
    """Inverse of a symmetric positive (3, 3), read from its upper half."""
    a, b, c, d, e, f = H[0, 0], H[0, 1], H[0, 2], H[1, 1], H[1, 2], H[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    out[0, 0], out[0, 1], out[0, 2] = A / det, B / det, C / det
    out[1, 1], out[1, 2] = (a * f - c * c) / det, (b * c - a * e) / det
    out[2, 2] = (a * d - b * b) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


def warm_up() -> None:
    """Compile the kernels."""
    p = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    var, cov = np.full(3, 1e-4), np.tile(1e-4 * np.eye(2), (3, 1, 1))
    none, nothing = np.zeros(3), np.zeros((3, 3))
    buckets = buckets_of(p, 0.1)
    pairs = pairs_of(p, 10.0)
    assert pairs is not None
    _, bases, _, _ = vote(p, var, p, var, pairs, buckets, 9.0, none, nothing, 9.0, MAX_TESTS)
    refine(bases[0], p, cov, p, cov, buckets, 9.0, 2e-4, none, nothing)
