# SPDX-License-Identifier: Apache-2.0
"""Fit of a pose to all detections that match a reflector there, from a pair of matches on."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.matching.reflectors.pair_votes import (
    MAX_TESTS,
    Buckets,
    Ints,
    Measured,
    PosePrior,
    buckets_of,
    cell_of,
    pairs_of,
    vote,
)
from rlml_slam.se2 import Array, wrapped_by_turns

LOOSE = 4.0  # a match waits while the pose's variance there is this many times the noise
ROUNDS = 12  # of matching and fitting; a pose that still changes is taken as it is


@kernel
def refine(
    base: Ints, seen: Measured, known: Measured, buckets: Buckets, gate2: float, noise: float,
    prior: PosePrior,
) -> tuple[Array, Array, Ints, float]:  # fmt: skip
    """The pose of one proposal, fitted to all detections that match there.

    ``noise`` [m^2] is the largest variance of a match. Returns pose (3,), its cov (3, 3), match
    (k,) (reflector or -1) and the squared Mahalanobis distance of all matches and the prior.
    """
    z, p, k = seen.points, known.points, len(seen.points)
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
    cov, chi2 = _fit(pose, match, seen, known, prior)
    for _ in range(ROUNDS):
        matches, changed = 0, False
        for n in range(k):
            before[n] = match[n]
        _match_all(pose, cov, match, seen, known, buckets, gate2, noise)
        for n in range(k):
            matches += match[n] >= 0
            changed |= match[n] != before[n]
        if matches < 2:
            break
        cov, chi2 = _fit(pose, match, seen, known, prior)
        if not changed:
            break
    return pose, cov, match, chi2


@part
def _match_all(
    pose: Array, cov: Array, match: Ints, seen: Measured, known: Measured, buckets: Buckets,
    gate2: float, noise: float,
) -> None:  # fmt: skip
    """Write the nearest reflector inside the gate, one detection for each, or -1 to ``match``."""
    z, p, p_cov, k = seen.points, known.points, known.cov, len(seen.points)
    owner = np.full(len(p), -1, np.int64)
    distance = np.full(k, np.inf)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for n in range(k):
        match[n] = -1
        rx, ry = c * z[n, 0] - s * z[n, 1], s * z[n, 0] + c * z[n, 1]
        x, y = pose[0] + rx, pose[1] + ry
        cell = cell_of(x, y, buckets)
        if cell < 0:
            continue
        # of the pose at this point: J cov J^T with J = [1 0 -ry; 0 1 rx]
        xx = cov[0, 0] - 2.0 * ry * cov[0, 2] + ry * ry * cov[2, 2]
        yy = cov[1, 1] + 2.0 * rx * cov[1, 2] + rx * rx * cov[2, 2]
        xy = cov[0, 1] + rx * cov[0, 2] - ry * cov[1, 2] - rx * ry * cov[2, 2]
        if xx + yy > LOOSE * noise:
            continue
        axx, axy, ayy = _turned(seen.cov, n, c, s)
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
    pose: Array, match: Ints, seen: Measured, known: Measured, prior: PosePrior
) -> tuple[Array, float]:
    """Move ``pose`` to the weighted least squares of its matches and the prior.

    Minimises sum r^T S^-1 r with r = p_j - (t + R z_i), S = R C_i R^T + P_j. Returns the inverse
    of the information and the minimum.
    """
    z, p, p_cov, information = seen.points, known.points, known.cov, prior.information
    H, g, d, chi2 = np.zeros((3, 3)), np.zeros(3), np.zeros(3), 0.0
    cov = np.zeros((3, 3))
    for iteration in range(6):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        for i in range(3):
            d[i] = pose[i] - prior.pose[i]
        d[2] = wrapped_by_turns(d[2])
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
            axx, axy, ayy = _turned(seen.cov, n, c, s)
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
    pose[2] = wrapped_by_turns(pose[2])
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
    """Compile the kernels of the votes and of the fit."""
    p = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    points = Measured(p, np.tile(1e-4 * np.eye(2), (3, 1, 1)), np.full(3, 1e-4))
    prior = PosePrior(np.zeros(3), np.zeros((3, 3)), 9.0)
    buckets, pairs = buckets_of(p, 0.1), pairs_of(p, 10.0)
    assert pairs is not None
    votes = vote(points, points, pairs, buckets, 9.0, prior, MAX_TESTS)
    refine(votes.bases[0], points, points, buckets, 9.0, 2e-4, prior)
