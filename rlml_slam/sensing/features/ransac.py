# SPDX-License-Identifier: Apache-2.0
"""Which readings of a sweep form lines: random samples and the consensus about them, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array

Indices = NDArray[np.int64]


@kernel
def find_lines(
    points: Array,
    angle: Array,
    draws: Array,
    sample_angle: float,
    tolerance: float,
    consensus: int,
    max_gap: float,
) -> Indices:
    """(n,): the line that each reading is of, counted as they are found, -1 for none.

    ``points`` (n, 2) in the order of their ``angle`` (n,) from the laser. A trial takes a row of
    ``draws`` (N, 1 + S) in [0, 1): a first reading, and S within ``sample_angle`` of it. A line
    through them is accepted where at least ``consensus`` readings lie within ``tolerance`` [m];
    what is on it takes no part in later trials.
    """
    line_of = np.full(len(points), -1, np.int64)
    left = np.arange(len(points))
    found = 0
    for trial in range(len(draws)):
        if len(left) < consensus:
            break
        first = int(draws[trial, 0] * len(left))
        around = angle[left]
        low = np.searchsorted(around, around[first] - sample_angle)
        high = np.searchsorted(around, around[first] + sample_angle, side='right')
        sample = np.empty(draws.shape[1], np.int64)
        if high - low < len(sample):
            continue
        sample[0] = left[first]
        for k in range(1, len(sample)):
            sample[k] = left[low + int(draws[trial, k] * (high - low))]
        rho, a = fit(points, sample)
        near = _on_line(points, left, rho, a, tolerance)
        if len(near) < consensus:
            continue
        # least squares again, with all readings on the old line
        rho, a = fit(points, near)
        members = _without_gap(
            points, _on_line(points, left, rho, a, tolerance), a, left[first], max_gap
        )
        if len(members) < consensus:
            continue
        line_of[members] = found
        found += 1
        left = left[line_of[left] < 0]
    return line_of


@kernel
def fit(points: Array, rows: Indices) -> tuple[float, float]:
    """Total least squares line through some points: (rho, alpha), rho of either sign."""
    n = len(rows)
    mx = my = xx = xy = yy = 0.0
    for k in rows:
        mx += points[k, 0] / n
        my += points[k, 1] / n
    for k in rows:
        dx, dy = points[k, 0] - mx, points[k, 1] - my
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    a = 0.5 * math.atan2(-2.0 * xy, yy - xx)
    return mx * math.cos(a) + my * math.sin(a), a


@part
def _on_line(points: Array, rows: Indices, rho: float, a: float, tolerance: float) -> Indices:
    c, s = math.cos(a), math.sin(a)
    out = np.empty(len(rows), np.int64)
    count = 0
    for k in rows:
        if abs(c * points[k, 0] + s * points[k, 1] - rho) <= tolerance:
            out[count] = k
            count += 1
    return out[:count]


@part
def _without_gap(points: Array, members: Indices, a: float, first: int, max_gap: float) -> Indices:
    """The part without gaps that holds the first reading: a wall, not all that is in its line."""
    c, s = math.cos(a), math.sin(a)
    along = np.empty(len(members))
    for k in range(len(members)):
        along[k] = c * points[members[k], 1] - s * points[members[k], 0]
    order = np.argsort(along, kind='mergesort')
    here = -1
    for k in range(len(order)):
        if members[order[k]] == first:
            here = k
    if here < 0:
        return members[:0]
    low = high = here
    while low > 0 and along[order[low]] - along[order[low - 1]] <= max_gap:
        low -= 1
    while high < len(order) - 1 and along[order[high + 1]] - along[order[high]] <= max_gap:
        high += 1
    return members[order[low : high + 1]]


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    x = np.linspace(1.0, 2.0, 8)
    points = np.stack([x, np.ones(8)], -1)
    find_lines(points, x, np.full((1, 3), 0.5), 3.0, 0.1, 3, 1.0)
    fit(points, np.arange(8))
