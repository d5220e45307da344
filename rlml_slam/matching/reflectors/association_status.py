# SPDX-License-Identifier: Apache-2.0
"""What becomes of each detection once the matches are chosen: its status, and doubtful matches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Status

WIDE = math.log(16.0)  # of the area of an ellipse, squared: each axis twice the detection's
USED, GATED, NEW = Status.USED.value, Status.GATED.value, Status.NEW.value
AMBIGUOUS, DEFERRED = Status.AMBIGUOUS.value, Status.DEFERRED.value
Indices = NDArray[np.int64]


class Limits(NamedTuple):
    """The parameters as kernels take them; gates are squared Mahalanobis distances."""

    gate: float
    new_gate: float
    min_separation: float
    blur: float
    density: float
    sure: float


@kernel
def compatible_pairs(
    seen: Indices, known: Indices, d2: Array, limits: Limits
) -> tuple[NDArray[np.bool_], Indices, Indices, bool]:
    """(k, m): inside the gate and not of different identity; an id needs no gate but sense.

    ``seen`` (k,) and ``known`` (m,) are ids. Then the pairs themselves as rows and columns, and
    whether each detection and each reflector is in one at most.
    """
    k, m = d2.shape
    compatible = np.zeros((k, m), np.bool_)
    rows, cols = np.empty(k, np.int64), np.empty(k, np.int64)
    met = np.zeros(m, np.bool_)
    count, alone = 0, True
    for i in range(k):
        first = True
        for j in range(m):
            if seen[i] == ANONYMOUS or known[j] == ANONYMOUS:
                compatible[i, j] = d2[i, j] < limits.gate
            else:
                compatible[i, j] = seen[i] == known[j] and d2[i, j] < limits.new_gate
            if not compatible[i, j]:
                continue
            alone = alone and first and not met[j]
            if first:
                rows[count], cols[count] = i, j
                count += 1
            first, met[j] = False, True
    return compatible, rows[:count], cols[:count], alone


@kernel
def separable(noise: Array, ids: Indices, limits: Limits) -> Array:
    """Least distance (k,) [m] at which two reflectors can be distinguished.

    That is ``min_separation``; for an anonymous detection it is at least ``blur`` times the
    largest sigma of its ``noise`` (k, 2, 2), as it may be of either of two reflectors within it.
    """
    out = np.empty(len(ids))
    for i in range(len(ids)):
        out[i] = limits.min_separation
        if ids[i] == ANONYMOUS:
            a, b, d = noise[i, 0, 0], noise[i, 0, 1], noise[i, 1, 1]
            largest = 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
            out[i] = max(out[i], limits.blur * math.sqrt(largest))
    return out


@kernel
def judge(
    pose: Array,
    points: Array,
    known: Indices,
    recent: NDArray[np.bool_],
    is_careful: bool,
    seen: Array,
    noise: Array,
    ids: Indices,
    d2: Array,
    log_det: Array,
    compatible: NDArray[np.bool_],
    rows: Indices,
    cols: Indices,
    limits: Limits,
) -> tuple[Indices, Indices, Array]:
    """Match (k,), status (k,) and distance2 (k,) of detections from the pairs ``rows``, ``cols``.

    With ``is_careful``, an anonymous match with what is not ``recent`` (m,) must be sure.
    """
    k, m = d2.shape
    match, status = np.full(k, -1, np.int64), np.full(k, NEW, np.int64)
    distance2 = np.full(k, np.nan)
    for h in range(len(rows)):
        i, j = rows[h], cols[h]
        doubtful = is_careful and ids[i] == ANONYMOUS and not recent[j]
        if doubtful and not odds(d2[i], log_det[i], j, limits.density) > limits.sure:
            continue
        match[i], status[i], distance2[i] = j, USED, d2[i, j]
    limit = separable(noise, ids, limits)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(k):
        if match[i] >= 0:
            continue
        x = pose[0] + c * seen[i, 0] - s * seen[i, 1]
        y = pose[1] + s * seen[i, 0] + c * seen[i, 1]
        fits = is_near = is_recent = is_known = False
        likeliest = 0
        for j in range(m):
            near = math.hypot(points[j, 0] - x, points[j, 1] - y) < limit[i]
            near = near or d2[i, j] < limits.new_gate
            is_near = is_near or near
            is_recent = is_recent or (near and recent[j])
            fits = fits or compatible[i, j]
            is_known = is_known or known[j] == ids[i]
            if d2[i, j] + log_det[i, j] < d2[i, likeliest] + log_det[i, likeliest]:
                likeliest = j
        if ids[i] == ANONYMOUS:
            if is_near:  # neither used nor new
                status[i] = AMBIGUOUS if fits else GATED
                own = math.log(noise[i, 0, 0] * noise[i, 1, 1] - noise[i, 0, 1] * noise[i, 1, 0])
                # the likeliest reflector's place is less certain than the detection itself
                is_wide = log_det[i, likeliest] > own + WIDE
                if is_careful and is_wide and not is_recent:
                    status[i] = DEFERRED
        elif is_known:
            status[i] = AMBIGUOUS if fits else GATED
    if is_careful:
        keep_apart(seen, ids, limit, status)
    return match, status, distance2


@part
def odds(d2: Array, log_det: Array, j: int, density: float) -> float:
    """Probability of match j, against all other reflectors and one not yet mapped.

    The latter stands anywhere with ``density``, so a match counts for nothing where the pose is
    so uncertain that an unknown reflector would be expected within its ellipse as well. One wrong
    match costs more than many that wait.
    """
    total = 0.0
    for q in range(len(d2)):
        total += math.exp(-0.5 * (log_det[q] + d2[q]))
    peak = math.exp(-0.5 * log_det[j]) / (2.0 * math.pi)
    against_others = math.exp(-0.5 * (log_det[j] + d2[j])) / total
    return against_others * peak / (peak + density)


@part
def keep_apart(seen: Array, ids: Indices, limit: Array, status: Indices) -> None:
    """Of unknown detections nearer than ``limit``, only the first may begin a reflector."""
    for i in range(len(ids)):
        if ids[i] != ANONYMOUS or (status[i] != NEW and status[i] != DEFERRED):
            continue
        for h in range(i):
            begins = status[h] == NEW or status[h] == DEFERRED
            gap = math.hypot(seen[h, 0] - seen[i, 0], seen[h, 1] - seen[i, 1])
            if begins and gap < limit[i]:
                status[i] = AMBIGUOUS
                break


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    limits = Limits(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    ids, noise, d2 = np.zeros(1, np.int64), np.eye(2)[None], np.ones((1, 1))
    compatible, rows, cols, _ = compatible_pairs(ids, ids, d2, limits)
    separable(noise, ids, limits)
    judge(
        np.zeros(3), np.ones((1, 2)), ids, np.ones(1, np.bool_), True, np.ones((1, 2)), noise,
        ids, d2, d2, compatible, rows, cols, limits,
    )  # fmt: skip
