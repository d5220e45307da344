# SPDX-License-Identifier: Apache-2.0
"""Reflectors that do not stand where the layout has them: data snooping with free poses.

Innovations nu = J_x dx + J_m delta + noise have the Jacobians of the front end (eq. 1). The pose
error dx of each scan is eliminated, with a wide prior about the pose of the run; what is left are
normal equations N delta = b of all displacements. The displacement of one reflector is
N_jj^-1 b_j if the others stand right. The most significant one is set free, then the next
(W. Baarda, *A testing procedure for use in geodetic networks*, 1968).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.reflectors.innovations import expected
from rlml_slam.planning.audit.evidence import Evidence
from rlml_slam.se2 import Array

POSE_SIGMA = np.array([0.1, 0.1, np.radians(2.0)])  # [m, m, rad] of the poses of the run
LEAST = 8  # sightings with others in view
RARE = 1e-3  # chance that any reflector of a sound layout is said to be displaced
XY = np.arange(2)
MOST = 1 / 3  # share of the reflectors that may be displaced


class Displacement(NamedTuple):
    """``delta`` (m, 2) [m], NaN where a reflector stands right; ``sigma`` (m,) of it.

    ``chi2`` and ``dof`` (n,) of each scan, with the displaced ones where they are.
    """

    delta: Array
    sigma: Array
    chi2: Array
    dof: Array


def displacement(e: Evidence, tolerance: float) -> Displacement:
    """Find them; places of a layout are known to ``tolerance`` [m], besides their covariance."""
    m, n = len(e.site.reflectors), len(e.sightings.stamps)
    prior = np.diag(1.0 / POSE_SIGMA**2)
    N, b = np.zeros((m, 2, m, 2)), np.zeros((m, 2))
    scans, count = [], np.zeros(m)
    for k in range(n):
        rows = np.flatnonzero(e.seen[k] >= 0)
        if len(rows) < 2:
            continue
        J, M, W, nu = _linearized(e, k, rows)
        JW, MW = J.transpose(0, 2, 1) @ W, M.transpose(0, 2, 1) @ W
        H = prior + (JW @ J).sum(axis=0)
        g = np.einsum('kij,kj->i', JW, nu)
        C = JW @ M  # (k, 3, 2)
        HC = np.linalg.solve(H, C.transpose(1, 0, 2).reshape(3, -1)).reshape(3, -1, 2)
        b[rows] += np.einsum('kij,kj->ki', MW, nu) - np.einsum('ikj,i->kj', HC, g)
        N[np.ix_(rows, XY, rows, XY)] -= np.einsum('aip,ibq->apbq', C, HC)
        N[rows, :, rows, :] += MW @ M
        count[rows] += 1
        scans.append((k, rows, M, W, JW, H, nu))
    delta, cov = _snoop(N, b, count, e.site.cov + tolerance**2 * np.eye(2))
    chi2, dof = np.zeros(n), np.zeros(n)
    shift = np.nan_to_num(delta)
    for k, rows, M, W, JW, H, nu in scans:
        r = nu - np.einsum('kij,kj->ki', M, shift[rows])
        g = np.einsum('kij,kj->i', JW, r)
        chi2[k] = np.einsum('ki,kij,kj->', r, W, r) - g @ np.linalg.solve(H, g)
        dof[k] = max(2 * len(rows) - 3, 1)
    return Displacement(delta, np.sqrt(np.linalg.eigvalsh(cov)[:, -1]), chi2, dof)


def _linearized(
    e: Evidence, scan: int, rows: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Jacobians by pose (k, 2, 3) and reflector (k, 2, 2), weights, innovations (k, 2)."""
    z, J = np.empty((len(rows), 2)), np.empty((len(rows), 2, 5))
    pose, at = e.sightings.poses[scan], e.seen[scan, rows]
    for i, (x, y) in enumerate(e.site.reflectors.points[rows]):
        expected(pose, x, y, z[i], J[i])
    return J[..., :3], J[..., 3:], np.linalg.inv(e.sightings.cov[at]), e.sightings.points[at] - z


def _snoop(N: Array, b: Array, count: Array, known: Array) -> tuple[Array, Array]:
    """Displacements (m, 2), NaN where none is significant, and covariances (m, 2, 2)."""
    m = len(b)
    delta, cov = np.full((m, 2), np.nan), np.zeros((m, 2, 2))
    limit = gate(1.0 - RARE / max(m, 1))
    free: list[int] = []
    while len(free) <= MOST * m:
        left, rest = _without(N, b, free)
        best, worst = -1, limit
        for j in np.flatnonzero(count >= LEAST).tolist():
            if j in free or np.linalg.cond(left[j]) > 1e12:
                continue
            P = np.linalg.inv(left[j])
            d = P @ rest[j]
            d2 = d @ np.linalg.solve(P + known[j], d)
            if d2 > worst:
                best, worst = j, d2
        if best < 0:
            break
        free.append(best)
    if free:
        A = _of(N, free)
        delta[free] = np.linalg.solve(A, b[free].ravel()).reshape(-1, 2)
        P = np.linalg.inv(A).reshape(len(free), 2, len(free), 2)
        for k, j in enumerate(free):
            cov[j] = P[k, :, k] + known[j]
    return delta, cov


def _without(N: Array, b: Array, free: list[int]) -> tuple[Array, Array]:
    """Blocks (m, 2, 2) and right side (m, 2) with the displacements of ``free`` eliminated."""
    m = len(b)
    own = N[np.arange(m), :, np.arange(m), :]
    if not free:
        return own, b
    A = _of(N, free)
    across = N[:, :, free, :].reshape(m, 2, -1)
    gain = np.linalg.solve(A, across.reshape(2 * m, -1).T).T.reshape(m, 2, -1)
    return own - gain @ across.transpose(0, 2, 1), b - gain @ b[free].ravel()


def _of(N: Array, free: list[int]) -> Array:
    """The block (2f, 2f) of some reflectors."""
    block: Array = N[free][:, :, free].reshape(2 * len(free), -1)
    return block
