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


class Seen(NamedTuple):
    """Detections: ``points`` (k, 2) in the base frame, covariances ``noise`` (k, 2, 2), ids."""

    points: Array
    noise: Array
    ids: Indices


class Known(NamedTuple):
    """Reflectors: ``points`` (m, 2) in the map, ids, and whether seen recently (m,).

    With ``is_careful``, an anonymous match with what is not recent must be sure.
    """

    points: Array
    ids: Indices
    recent: NDArray[np.bool_]
    is_careful: bool


class Pairing(NamedTuple):
    """Squared distances ``d2`` and ``log_det`` of their covariances (k, m), ``compatible`` (k, m).

    The chosen pairs are ``rows`` and ``cols``.
    """

    d2: Array
    log_det: Array
    compatible: NDArray[np.bool_]
    rows: Indices
    cols: Indices


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
    pose: Array, known: Known, seen: Seen, pairing: Pairing, limits: Limits
) -> tuple[Indices, Indices, Array]:
    """Match (k,), status (k,) and distance2 (k,) of detections from the chosen pairs."""
    k, d2, log_det = len(seen.ids), pairing.d2, pairing.log_det
    match, status = np.full(k, -1, np.int64), np.full(k, NEW, np.int64)
    distance2 = np.full(k, np.nan)
    for h in range(len(pairing.rows)):
        i, j = pairing.rows[h], pairing.cols[h]
        doubtful = known.is_careful and seen.ids[i] == ANONYMOUS and not known.recent[j]
        if doubtful and not odds(d2[i], log_det[i], j, limits.density) > limits.sure:
            continue
        match[i], status[i], distance2[i] = j, USED, d2[i, j]
    limit = separable(seen.noise, seen.ids, limits)
    for i in range(k):
        if match[i] < 0:
            status[i] = _unmatched(i, pose, known, seen, pairing, limit[i], limits)
    if known.is_careful:
        keep_apart(seen.points, seen.ids, limit, status)
    return match, status, distance2


@part
def _unmatched(
    i: int, pose: Array, known: Known, seen: Seen, pairing: Pairing, limit: float, limits: Limits
) -> int:
    """Status of detection i, which has no match."""
    d2, log_det = pairing.d2[i], pairing.log_det[i]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] + c * seen.points[i, 0] - s * seen.points[i, 1]
    y = pose[1] + s * seen.points[i, 0] + c * seen.points[i, 1]
    fits = is_near = is_recent = is_known = False
    likeliest = 0
    for j in range(len(known.ids)):
        near = math.hypot(known.points[j, 0] - x, known.points[j, 1] - y) < limit
        near = near or d2[j] < limits.new_gate
        is_near = is_near or near
        is_recent = is_recent or (near and known.recent[j])
        fits = fits or pairing.compatible[i, j]
        is_known = is_known or known.ids[j] == seen.ids[i]
        if d2[j] + log_det[j] < d2[likeliest] + log_det[likeliest]:
            likeliest = j
    if not (is_near if seen.ids[i] == ANONYMOUS else is_known):
        return NEW
    if seen.ids[i] == ANONYMOUS and known.is_careful and not is_recent:
        S = seen.noise[i]
        own = math.log(S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0])
        # the likeliest reflector's place is less certain than the detection itself
        if log_det[likeliest] > own + WIDE:
            return DEFERRED
    return AMBIGUOUS if fits else GATED  # neither used nor new


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
    known = Known(np.ones((1, 2)), ids, np.ones(1, np.bool_), True)
    seen = Seen(np.ones((1, 2)), noise, ids)
    judge(np.zeros(3), known, seen, Pairing(d2, d2, compatible, rows, cols), limits)
