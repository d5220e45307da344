# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton, compiled: H dx = -g, x <- x + dx.

The cost may rise for a few steps, which is how it leaves bad starts in which methods that must
descend stay.

The stopping test needs no further factorization. With q the error of the linear model r + J d, a
step leaves the cost at |r + J d + q|^2 where |r + J d|^2 was predicted, and what the next step can
gain is the part of |q|^2 that its model reaches: as long as the cost is the predicted one, little
is left to gain. Where it is not, and with robust losses, whose cost falls by more than predicted,
the old factor, at the cost of half a solve, predicts the gain of a further step. Neither is a
bound: of small graphs with landmarks one in ten gains up to twenty times the tolerance by one
more step. The old factor is not good for the step itself: lines of sight that turn by little
couple directions of high and of low information.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.linearization import apply_step, linearize, linearize_again
from rlml_slam.graph.model.packed_system import System
from rlml_slam.graph.sparse.multifrontal import factorise, solve_lower, solve_upper
from rlml_slam.se2 import Array

# Gauss-Newton gives up after this many steps in a row without a new lowest cost
PATIENCE = 4
# After a step whose predicted decrease is more than this share of the cost, the old factor is not
# used: it cannot predict the end of a descent that has just begun.
FAR = 0.5


class Progress(NamedTuple):
    """Where a minimisation stands."""

    cost: float
    chi2: float
    iterations: int
    converged: bool


@part
def copy(source: Array, target: Array) -> None:
    """Copy rows."""
    for i in range(len(source)):
        for k in range(source.shape[1]):
            target[i, k] = source[i, k]


@part
def _squares(x: Array) -> float:
    total = 0.0
    for i in range(len(x)):
        total += x[i] * x[i]
    return total


@kernel
def factor(system: System) -> int:
    """Cholesky factor of H with step = -L^-1 g; -1, or the supernode that failed."""
    g, step = system.g, system.step
    for i in range(len(g)):
        step[i] = -g[i]
    return factorise(system.fronts, system.entries, system.values, system.left, system.right, step)


@kernel
def newton_step(system: System) -> float:
    """Step = -H^-1 g after ``factor``; returns the predicted decrease, -g step."""
    decrease = _squares(system.step)
    solve_upper(system.fronts, system.entries, system.values, system.step)
    return decrease


@kernel
def gauss_newton(
    system: System, poses: Array, landmarks: Array, cost: float, chi2: float,
    max_iterations: int, tolerance: float, floor: float,
) -> Progress:  # fmt: skip
    """Gauss-Newton with patience; ends at the best estimate on the way.

    The system is to be linearized at the start, where it has ``cost`` and ``chi2``. Converged
    means that a further step is expected to lower the cost by less than ``tolerance`` of it plus
    ``floor``.
    """
    kept, kept_landmarks = poses.copy(), landmarks.copy()
    best, best_chi2 = cost, chi2
    robust = False
    for k in range(len(system.losses)):
        robust = robust or system.losses[k, 0] != 0
    iterations, misses, converged = 0, 0, False
    while misses <= PATIENCE and math.isfinite(cost) and factor(system) < 0:
        predicted = _squares(system.step)
        converged = predicted <= tolerance * cost + floor
        if converged or iterations == max_iterations:
            break
        solve_upper(system.fronts, system.entries, system.values, system.step)
        apply_step(system.variables, system.step, poses, landmarks)
        iterations += 1
        model = cost - predicted
        # near the minimum the panels hold the old factor until it has been used
        far = not robust and predicted > FAR * cost
        cost, chi2 = linearize(system, poses, landmarks, far)
        if cost < best:
            best, best_chi2, misses = cost, chi2, 0
            copy(poses, kept)
            copy(landmarks, kept_landmarks)
        else:
            misses += 1
        small = tolerance * cost + floor
        converged = not robust and abs(cost - model) <= small
        if not (converged or far):
            converged = _predicted_decrease(system) <= small
        if converged:
            break
        if not far:
            linearize_again(system, poses, landmarks, True)
    if not cost <= best:
        copy(kept, poses)
        copy(kept_landmarks, landmarks)
        converged = converged and cost <= best * (1.0 + 1e-9) + floor
        cost, chi2 = best, best_chi2
    return Progress(cost, chi2, iterations, converged)


@part
def _predicted_decrease(system: System) -> float:
    """Decrease of the cost by a step with the old factor at the new gradient."""
    g, step = system.g, system.step
    for i in range(len(g)):
        step[i] = -g[i]
    solve_lower(system.fronts, system.entries, system.values, step)
    return _squares(step)
