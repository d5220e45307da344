# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a sliding window of robot and features, and marginalisation of its oldest.

A step's state is (x, y, theta, f_1x, f_1y, ...) with a slot for every feature that the window may
hold, (n,) with n = 3 + 2 M. ``active`` (M,) says which slots are in use at a step; the others
have identity rows, so that all blocks keep one size and the equations stay block tridiagonal.
A feature lives on into the next step where it is active in both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.deformable.block_tridiagonal import (
    cholesky,
    factorize,
    solve,
    solve_lower,
    solve_upper,
)
from rlml_slam.deformable.model import motion, observe_feature
from rlml_slam.se2 import Array, rotation

Flags = NDArray[np.bool_]


class Steps(NamedTuple):
    """Up to K steps of the window, and what leads from step k to k + 1."""

    mean: Array  # (K, n)
    active: Flags  # (K, M)
    leads: Flags  # (K, M) features that the carrier turns about
    delta: Array  # (K, 3) odometry, in the robot's frame
    motion_info: Array  # (K, 3, 3) information of it, in the same frame
    carrier: Array  # (K, 3) its motion x, y [m], and turn [rad]
    shift: Array  # (K, 3) of the carrier too, in the robot's frame, (x, y, 0)
    own: Array  # (K,) variance of each feature's own motion [m^2]
    common: Array  # (K,) variance of the motion that all features share [m^2]
    z: Array  # (K, M, 2) sightings in the robot's frame, NaN where unseen
    z_info: Array  # (K, M, 2, 2)


class Prior(NamedTuple):
    """What marginalised steps know of step 0: a quadratic about ``at``."""

    at: Array  # (n,)
    info: Array  # (n, n)
    slope: Array  # (n,) gradient at ``at``


@kernel
def carry(
    state: Array, lives: Flags, leads: Flags, delta: Array, carrier: Array, shift: Array,
    after: Array, F: Array,
) -> None:  # fmt: skip
    """The state one step on into ``after`` (n,), and its Jacobian ``F`` (n, n).

    The robot moves by odometry ``delta`` (3,) in its own frame; the features that live on move
    with the ``carrier`` (t, turn), f' = f + t + R(theta) b + (R(turn) - I)(f - c), b the ``shift``
    (3,) and c the centroid of those of them that lead (a ghost does not), or of all where none
    does. Dead slots are 0.
    """
    F[:] = 0.0
    after[:] = 0.0
    x, y, theta, a, b = motion(state[0], state[1], state[2], delta)
    after[0], after[1], after[2] = x, y, theta
    F[0, 0] = F[1, 1] = F[2, 2] = 1.0
    F[0, 2], F[1, 2] = a, b
    center = np.zeros(2)
    counts = lives & leads if np.any(lives & leads) else lives
    num = 0
    for j in range(len(lives)):
        if counts[j]:
            center += state[3 + 2 * j : 5 + 2 * j]
            num += 1
    if num == 0:
        return
    center /= num
    tx, ty, _, a, b = motion(carrier[0], carrier[1], state[2], shift)
    turn = carrier[2]
    c, s = math.cos(turn) - 1.0, math.sin(turn)
    for j in range(len(lives)):
        if not lives[j]:
            continue
        k = 3 + 2 * j
        dx, dy = state[k] - center[0], state[k + 1] - center[1]
        after[k] = state[k] + tx + c * dx - s * dy
        after[k + 1] = state[k + 1] + ty + s * dx + c * dy
        F[k, k] = F[k + 1, k + 1] = 1.0
        F[k, 2], F[k + 1, 2] = a, b
        if turn == 0.0:
            continue
        for i in range(len(lives)):
            if lives[i]:
                share = (1.0 if i == j else 0.0) - (1.0 / num if counts[i] else 0.0)
                m = 3 + 2 * i
                F[k, m] += share * c
                F[k, m + 1] -= share * s
                F[k + 1, m] += share * s
                F[k + 1, m + 1] += share * c


@kernel
def motion_information(
    theta: float, motion_info: Array, lives: Flags, own: float, common: float, out: Array
) -> None:
    """Information ``out`` (n, n) of the step's noise, dead slots 0.

    ``motion_info`` (3, 3) is in the robot's frame at ``theta``. The features' noise is
    own I + common 11^T per axis [m^2], whose inverse is I/own - common/(own (own + m common)).
    """
    out[:] = 0.0
    c, s = math.cos(theta), math.sin(theta)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    out[:3, :3] = R @ motion_info @ R.T
    num = 0
    for j in range(len(lives)):
        if lives[j]:
            num += 1
    shared = common / (own * (own + num * common))
    for j in range(len(lives)):
        if not lives[j]:
            continue
        for i in range(len(lives)):
            if lives[i]:
                for r in range(2):
                    out[3 + 2 * j + r, 3 + 2 * i + r] = (1.0 / own if i == j else 0.0) - shared


@kernel
def _add_step(w: Steps, k: int, A: Array, B: Array, C: Array, g: Array, h: Array) -> float:
    """Residual e = x_{k+1} - f(x_k) of the motion of robot and carrier; returns its cost.

    A, B, C are H_kk, H_{k+1,k} and H_{k+1,k+1}; g and h the gradients of the two steps.
    """
    n = w.mean.shape[1]
    e, F, W = np.empty(n), np.empty((n, n)), np.empty((n, n))
    lives = w.active[k] & w.active[k + 1]
    carry(w.mean[k], lives, w.leads[k], w.delta[k], w.carrier[k], w.shift[k], e, F)
    motion_information(w.mean[k, 2], w.motion_info[k], lives, w.own[k], w.common[k], W)
    for i in range(n):
        e[i] = w.mean[k + 1, i] - e[i]
    WF, We = W @ F, W @ e
    A += F.T @ WF
    B -= WF
    C += W
    g -= F.T @ We
    h += We
    return float(e @ We)


@kernel
def _add_sightings(state: Array, z: Array, info: Array, A: Array, g: Array) -> float:
    """Residuals of the features seen (``z`` not NaN) at one step; returns their cost."""
    seen, H, index = np.empty(2), np.empty((2, 5)), np.array([0, 1, 2, 0, 0])
    cost = 0.0
    for j in range(len(z)):
        if math.isnan(z[j, 0]):
            continue
        observe_feature(state, j, seen, H)
        index[3], index[4] = 3 + 2 * j, 4 + 2 * j
        e = seen - z[j]
        We, WH = info[j] @ e, info[j] @ H
        HWH, HWe = H.T @ WH, H.T @ We
        cost += e @ We
        for k in range(5):
            g[index[k]] += HWe[k]
            for m in range(5):
                A[index[k], index[m]] += HWH[k, m]
    return cost


@kernel
def _add_prior(state: Array, prior: Prior, A: Array, g: Array) -> None:
    """The gradient and information that the prior has at ``state``."""
    A += prior.info
    g += prior.slope + prior.info @ (state - prior.at)


@kernel
def _fill_unused(active: Flags, A: Array) -> None:
    """Identity rows for the slots that are not in use."""
    for j in range(len(active)):
        if not active[j]:
            A[3 + 2 * j, 3 + 2 * j] = 1.0
            A[4 + 2 * j, 4 + 2 * j] = 1.0


@kernel
def linearize_window(
    w: Steps, length: int, prior: Prior, diagonal: Array, below: Array, g: Array
) -> float:
    """H and gradient of half the cost of the first ``length`` steps.

    Returns the cost of the measurements in the window, without the prior's.
    """
    diagonal[:] = 0.0
    below[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    _add_prior(w.mean[0], prior, diagonal[0], g[0])
    for k in range(length):
        cost += _add_sightings(w.mean[k], w.z[k], w.z_info[k], diagonal[k], g[k])
        if k + 1 < length:
            cost += _add_step(w, k, diagonal[k], below[k], diagonal[k + 1], g[k], g[k + 1])
        _fill_unused(w.active[k], diagonal[k])
    return cost


@kernel
def optimize_window(
    w: Steps, length: int, prior: Prior, max_iterations: int, tolerance: float, newest_cov: Array
) -> tuple[int, float]:
    """Gauss-Newton on the first ``length`` means in place; iterations, -1 if it failed, and cost.

    ``newest_cov`` (n, n) becomes the marginal covariance of the newest step.
    """
    n = w.mean.shape[1]
    diagonal, below = np.empty((length, n, n)), np.empty((length - 1, n, n))
    g = np.empty((length, n))
    iterations, cost = 0, 0.0
    while True:
        cost = linearize_window(w, length, prior, diagonal, below, g)
        if not factorize(diagonal, below):
            return -1, cost
        solve(diagonal, below, g)
        w.mean[:length] -= g
        iterations += 1
        if np.max(np.abs(g)) < tolerance or iterations >= max_iterations:
            break
    # the newest block is the last to be eliminated: its factor alone gives its marginal
    newest_cov[:] = np.eye(n)
    for k in range(n):
        solve_lower(diagonal[length - 1], newest_cov[k])
        solve_upper(diagonal[length - 1], newest_cov[k])
    return iterations, cost


@kernel
def marginalize_oldest(w: Steps, prior: Prior) -> bool:
    """Replace the prior on step 0 by the one on step 1 that the Schur complement leaves, in place.

    All that is known of step 0 goes into it: its prior, its sightings and the motion to step 1.
    False where step 0 is not determined.
    """
    n = w.mean.shape[1]
    A, B, C = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    g, h = np.zeros(n), np.zeros(n)
    _add_prior(w.mean[0], prior, A, g)
    _add_sightings(w.mean[0], w.z[0], w.z_info[0], A, g)
    _add_step(w, 0, A, B, C, g, h)
    _fill_unused(w.active[0], A)
    if not cholesky(A):
        return False
    for r in range(n):
        solve_lower(A, B[r])  # B <- B L^-T, so that B B^T is the B A^-1 B^T of the complement
    solve_lower(A, g)
    left = C - B @ B.T
    prior.info[:] = 0.5 * (left + left.T)
    prior.slope[:] = h - B @ g
    prior.at[:] = w.mean[1]
    return True


def motion_covariance(
    theta: float, motion_cov: Array, lives: Flags, own: float, common: float
) -> Array:
    """Covariance (n, n) of one step's noise, what motion_information inverts; dead slots 0."""
    n = 3 + 2 * len(lives)
    Q = np.zeros((n, n))
    R = np.eye(3)
    R[:2, :2] = rotation(theta)
    Q[:3, :3] = R @ motion_cov @ R.T
    alive = lives.astype(np.float64)
    Q[3:, 3:] = np.kron(np.diag(alive) * own + np.outer(alive, alive) * common, np.eye(2))
    return Q
