# SPDX-License-Identifier: Apache-2.0
"""Second start, for graphs in which Gauss-Newton does not converge from the first one.

Where the headings that edges measure are too noisy for a relaxation on their own, the positions
determine them better: both are relaxed together, with power iterations. These begin with the
headings relaxed alone or with the joint relaxation; which of the two leads to the global optimum
differs, most often it is the one of lower cost.
"""

from __future__ import annotations

import math

from rlml_slam.graph.batch.chordal_relaxation import relax, relax_jointly
from rlml_slam.graph.batch.gauss_newton import Progress, gauss_newton
from rlml_slam.graph.model.linearization import linearize
from rlml_slam.graph.model.packed_system import System
from rlml_slam.se2 import Array

# power iterations: from headings relaxed alone, from the joint relaxation
FEW, MANY = 3, 20

Estimate = tuple[Array, Array]


def restart(
    system: System, poses: Array, landmarks: Array, max_iterations: int, tolerance: float,
    floor: float,
) -> Progress:  # fmt: skip
    """Minimise from a second start, or from the current estimate where its cost is lower.

    The lowest estimate is left in ``poses`` and ``landmarks``.
    """
    first = poses.copy(), landmarks.copy()
    start = _second_start(system, poses, landmarks)
    at = linearize(system, *first, False)[0]
    best, iterations = Progress(math.inf, math.inf, 0, False), 0
    for estimate in (start, first):
        if estimate is None or (best.converged and best.cost <= at):
            continue
        cost, chi2 = linearize(system, *estimate, True)
        end = gauss_newton(system, *estimate, cost, chi2, max_iterations, tolerance, floor)
        iterations += end.iterations
        if end.cost <= best.cost:
            best = end
            poses[:], landmarks[:] = estimate
    return best._replace(iterations=iterations)


def _second_start(system: System, poses: Array, landmarks: Array) -> Estimate | None:
    starts = []
    for from_relaxed, power_steps in ((False, FEW), (True, MANY)):
        estimate = poses.copy(), landmarks.copy()
        alone = from_relaxed or relax(system, *estimate)
        if alone and relax_jointly(system, *estimate, from_relaxed, power_steps):
            starts.append((linearize(system, *estimate, False)[0], estimate))
    return min(starts, key=lambda start: start[0])[1] if starts else None
