# SPDX-License-Identifier: Apache-2.0
"""Powell's dog-leg, a trust-region method, which never raises the cost.

Nocedal and Wright, "Numerical Optimization", 2nd ed. (2006), chapter 4. The loop is Python
around the compiled linearization, factorization and solves. Steps are
measured in the norm of D, the diagonal of H, so metres and radians count by their information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam.compiled import kernel
from rlml_slam.graph.batch.gauss_newton import Progress, factor, newton_step
from rlml_slam.graph.model.linearization import apply_step, linearize
from rlml_slam.graph.model.packed_system import System
from rlml_slam.graph.sparse.multifrontal import max_height
from rlml_slam.graph.sparse.symbolic_analysis import Ints, Records
from rlml_slam.se2 import Array

# A step is accepted if it brings this share of the predicted decrease (Nocedal & Wright, eq. 4.20:
# anything from 0 to 1/4).
MIN_RATIO = 1e-4


@kernel
def curvature(fronts: Records, entries: Records, values: Array, x: Array) -> float:
    """X^T H x with H, not its factor, in the panels."""
    total = 0.0
    own = np.empty(max_height(fronts))
    for s in range(len(fronts) - 1):
        width, height, at = fronts[s]['width'], fronts[s]['height'], fronts[s]['panel']
        end = fronts[s + 1]['start']
        for p in range(fronts[s]['start'], end):
            i, k = entries[p]['local'], entries[p]['scalar']
            after = entries[p + 1]['local'] if p + 1 < end else height
            for r in range(after - i):
                own[i + r] = x[k + r]
        for j in range(width):
            column = 0.5 * values[at + j * height + j] * own[j]
            for i in range(j + 1, height):
                column += values[at + j * height + i] * own[i]
            total += 2.0 * column * own[j]
    return total


@dataclass
class _Trial:
    """Estimate with its cost, and the trial steps from it."""

    system: System
    poses: Array
    landmarks: Array
    cost: float
    chi2: float
    diagonal: Ints

    def linearize(self) -> Array:
        """H into the panels; its diagonal, in the order of elimination."""
        self.cost, self.chi2 = linearize(self.system, self.poses, self.landmarks, True)
        return np.asarray(self.system.values[self.diagonal])

    def factorise(self, scale: Array, damping: float) -> float:
        """Factor H + damping D, with more damping until that works; returns the damping used."""
        values = self.system.values
        for _ in range(30):
            values[self.diagonal] += damping * scale
            if factor(self.system) < 0:
                return damping
            damping = max(1e-8, 10.0 * damping)
            self.linearize()
        return math.inf

    def try_step(self, step: Array, predicted: float) -> float:
        """Take the step if the cost falls enough; the ratio of actual to predicted decrease."""
        before = self.poses.copy(), self.landmarks.copy(), self.system.g.copy()
        apply_step(self.system.variables, step, self.poses, self.landmarks)
        cost, chi2 = linearize(self.system, self.poses, self.landmarks, False)
        ratio = (self.cost - cost) / predicted if predicted > 0.0 else -1.0
        if ratio > MIN_RATIO and math.isfinite(cost):
            self.cost, self.chi2 = cost, chi2
        else:
            self.poses[:], self.landmarks[:], self.system.g[:] = before
            ratio = min(ratio, 0.0) if math.isfinite(cost) else -1.0
        return ratio


def _trial(system: System, poses: Array, landmarks: Array) -> _Trial:
    v = system.variables
    diagonal = np.empty(len(system.g), dtype=np.int64)
    for r in range(3):
        has = v['size'] > r
        diagonal[v['scalar'][has] + r] = v['address'][has] + r * (v['stride'][has] + 1)
    return _Trial(system, poses, landmarks, math.inf, math.inf, diagonal)


def dog_leg(
    system: System,
    poses: Array,
    landmarks: Array,
    max_iterations: int,
    tolerance: float,
    floor: float,
) -> Progress:
    """Powell's dog-leg: one factorisation per accepted step, none for a refused one."""
    trial = _trial(system, poses, landmarks)
    radius, iterations = -1.0, 0
    while iterations < max_iterations:
        scale = trial.linearize()
        steepest = -system.g / scale
        slope = float(-system.g @ steepest)
        curve = curvature(system.fronts, system.entries, system.values, steepest)
        if trial.factorise(scale, 0.0) > 1e12:
            break
        predicted = newton_step(system)
        if predicted <= tolerance * trial.cost + floor:
            return Progress(trial.cost, trial.chi2, iterations, True)
        newton = system.step.copy()
        if radius < 0.0:
            radius = math.sqrt(newton @ (scale * newton))
        ratio = 0.0
        while ratio <= 0.0 and iterations < max_iterations:
            step, model = _dog_leg_step(newton, steepest, scale, radius, slope, curve, predicted)
            length = math.sqrt(step @ (scale * step))
            iterations += 1
            ratio = trial.try_step(step, model)
            if ratio < 0.25:
                radius = 0.25 * length
            elif ratio > 0.75:
                radius = max(radius, 3.0 * length)
            if radius * radius <= 1e-3 * (tolerance * trial.cost + floor):
                return Progress(trial.cost, trial.chi2, iterations, True)
    return Progress(trial.cost, trial.chi2, iterations, False)


def _dog_leg_step(
    newton: Array,
    steepest: Array,
    scale: Array,
    radius: float,
    slope: float,
    curve: float,
    predicted: float,
) -> tuple[Array, float]:
    """(step within ``radius``, its predicted decrease).

    The Newton step if it fits, else the point where the path from the Cauchy point to it leaves
    the trust region, else the clipped Cauchy step. With steepest = -g / D, ``slope`` = -g steepest
    and ``curve`` = steepest H steepest.
    """
    if newton @ (scale * newton) <= radius * radius:
        return newton, predicted
    cauchy = slope / curve * steepest
    across = float(cauchy @ (scale * cauchy))
    if across >= radius * radius:
        t = radius / math.sqrt(float(steepest @ (scale * steepest)))
        return t * steepest, 2.0 * t * slope - t * t * curve
    # |cauchy + b (newton - cauchy)| = radius
    rest = newton - cauchy
    a2, a1 = float(rest @ (scale * rest)), float(cauchy @ (scale * rest))
    b = (-a1 + math.sqrt(max(0.0, a1 * a1 + a2 * (radius * radius - across)))) / a2
    # -2 g s - s H s for s = p steepest + b newton, with H newton = -g
    p = (1.0 - b) * slope / curve
    model = 2.0 * (p * slope + b * predicted) - (
        p * p * curve + 2.0 * p * b * slope + b * b * predicted
    )
    return cauchy + b * rest, model
