# SPDX-License-Identifier: Apache-2.0
"""Compiled Gauss-Newton.

It may climb for a few steps, which is how it leaves the bad starts in which methods that must
descend get stuck. After every step the old factor, at the price of a gradient and two triangular
solves, tells how much a further step would still gain: mostly nothing, which saves the last
factorisation; where it is little, that step is taken with the old factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.fronts import factorise, solve_lower, solve_upper
from rlml_slam.graph.linearize import linearize, move
from rlml_slam.graph.system import System
from rlml_slam.se2 import Array

# Gauss-Newton gives up after this many steps in a row without a new lowest cost
PATIENCE = 4
# an old factor serves for steps that promise less than this share of the cost, if the step that
# it was made for did not change the cost by more than the other share, and while it gains ground
SMALL_STEP = 1e-3
SMALL_CHANGE = 0.1
GROUND = 0.2


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


@kernel
def newton_step(system: System) -> float:
    """Step = -H^-1 g with the factor at hand; returns the decrease that it promises, -g step."""
    g, step = system.g, system.step
    for i in range(len(g)):
        step[i] = -g[i]
    solve_lower(system.fronts, system.entries, system.values, step)
    decrease = 0.0
    for i in range(len(g)):
        decrease += step[i] * step[i]
    solve_upper(system.fronts, system.entries, system.values, step)
    return decrease


@kernel
def gauss_newton(
    system: System, poses: Array, landmarks: Array,
    max_iterations: int, tolerance: float, floor: float,
) -> Progress:  # fmt: skip
    """Gauss-Newton with patience; ends at the best estimate that it met.

    Converged means that a further step promises to lower the cost by less than ``tolerance`` of
    it plus ``floor``.
    """
    kept, kept_landmarks = np.empty_like(poses), np.empty_like(landmarks)
    best, best_chi2, cost, chi2 = math.inf, math.inf, math.inf, math.inf
    promised, before = 0.0, 0.0
    iterations, misses = 0, 0
    fresh, reuse, moved, converged = True, False, True, False
    while True:
        cost, chi2 = linearize(system, poses, landmarks, fresh)
        if moved:
            if cost < best:
                best, best_chi2, misses = cost, chi2, 0
                copy(poses, kept)
                copy(landmarks, kept_landmarks)
            else:
                misses += 1
        if misses > PATIENCE or not math.isfinite(cost):
            break
        if (
            fresh
            and factorise(system.fronts, system.entries, system.values, system.left, system.right)
            >= 0
        ):
            break
        before = promised
        promised = newton_step(system)
        converged = promised <= tolerance * cost + floor
        if converged or iterations >= max_iterations:
            break
        if not fresh and not (reuse and promised < min(SMALL_STEP * cost, GROUND * before)):
            fresh, moved = True, False
            continue
        move(system.variables, system.step, poses, landmarks)
        if fresh:
            reuse = promised < SMALL_CHANGE * cost
        # a first step is rarely the last, and then the old factor need not be asked
        fresh = iterations == 0 and not reuse
        iterations += 1
        moved = True
    if not cost <= best:
        copy(kept, poses)
        copy(kept_landmarks, landmarks)
        converged = converged and cost <= best * (1.0 + 1e-9) + floor
        cost, chi2 = best, best_chi2
    return Progress(cost, chi2, iterations, converged)
