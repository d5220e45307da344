# SPDX-License-Identifier: Apache-2.0
"""A sweep of ranges becomes end points in the base frame at the first ray's stamp."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import brief
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

ARC = 0.02  # [s] over which the motion within a sweep is one arc
MOST_ARCS = 32


@brief
def _project(
    ranges: NDArray[np.float32],
    angle_min: float,
    increment: float,
    low: float,
    high: float,
    T_base_laser: Array,
    starts: Array,
    twists: Array,
) -> Array:
    """End points ``(m, 2)`` of the beams whose range is in [low, high]; NaN and Inf are not.

    ``starts`` and ``twists`` (a, 3) are the pose of base where each arc of the sweep begins, and
    its motion (log) in it, zero for a sweep without ray times.
    """
    n, arcs = len(ranges), len(twists)
    out = np.empty((n, 2))
    m = 0
    cl, sl = math.cos(T_base_laser[2]), math.sin(T_base_laser[2])
    moving = bool((twists != 0.0).any())
    # (cos, sin) of the beam's angle and of half of the base's turn, each from the beam before:
    # what rounding adds up to over a sweep is a billionth of a beam's noise
    bc, bs = math.cos(angle_min), math.sin(angle_min)
    step_bc, step_bs = math.cos(increment), math.sin(increment)
    arc, twist, start = -1, twists[0], starts[0]
    ch = step_ch = start_c = 1.0
    sh = step_sh = start_s = 0.0
    for k in range(n):
        if k:
            bc, bs = bc * step_bc - bs * step_bs, bs * step_bc + bc * step_bs
            ch, sh = ch * step_ch - sh * step_sh, sh * step_ch + ch * step_sh
        if moving and k * arcs // n > arc:
            arc = k * arcs // n
            twist, start = twists[arc], starts[arc]
            half = 0.5 * twist[2]
            begin = half * (k * arcs / n - arc)
            ch, sh = math.cos(begin), math.sin(begin)
            step_ch, step_sh = math.cos(half * arcs / n), math.sin(half * arcs / n)
            start_c, start_s = math.cos(start[2]), math.sin(start[2])
        r = float(ranges[k])
        if not (low <= r <= high):
            continue
        px, py = r * bc, r * bs
        x = T_base_laser[0] + cl * px - sl * py
        y = T_base_laser[1] + sl * px + cl * py
        if moving:
            # the arc is short: its chord, error O(w^2)
            f = k * arcs / n - arc
            tx = f * (ch * twist[0] - sh * twist[1])
            ty = f * (sh * twist[0] + ch * twist[1])
            c, s = ch * ch - sh * sh, 2.0 * sh * ch
            x, y = tx + c * x - s * y, ty + s * x + c * y
            x, y = start[0] + start_c * x - start_s * y, start[1] + start_s * x + start_c * y
        out[m, 0] = x
        out[m, 1] = y
        m += 1
    return out[:m]


def sweep_time(scan: Scan) -> float:
    """Time [s] from the first ray to one increment after the last."""
    return scan.time_increment * len(scan.ranges)


def num_arcs(lasts: float) -> int:
    """Number of arcs of the motion within a sweep that ``lasts`` [s]."""
    return min(max(math.ceil(lasts / ARC), 1), MOST_ARCS)


def arcs_of(sweep: Array) -> tuple[Array, Array]:
    """Poses (a, 3) of base at which the arcs of a sweep (a, 3) begin, and their twists (a, 3)."""
    starts = np.concatenate([np.zeros((1, 3)), sweep[:-1]])
    return starts, se2.log(se2.between(starts, sweep))


def base_at(sweep: Array, share: Array) -> Array:
    """Poses (n, 3) of base after each ``share`` (n,) of a sweep (a, 3), eq. 70."""
    starts, twists = arcs_of(sweep)
    arcs = share * len(sweep)
    k = np.minimum(arcs.astype(np.intp), len(sweep) - 1)
    return se2.compose(starts[k], se2.exp((arcs - k)[:, None] * twists[k]))


def project(scan: Scan, T_base_laser: Array, sweep: Array, max_range: float) -> Array:
    """Valid end points ``(m, 2)`` of a scan in the base frame at ``scan.stamp`` (eq. 70).

    ``sweep`` (a, 3) are the motions of base until the end of each of its arcs, which are of equal
    time; the last is that of :func:`sweep_time`. Ranges outside [range_min, min(range_max,
    max_range)] are left out.
    """
    ranges = np.asarray(scan.ranges, dtype=np.float32)
    high = min(float(scan.range_max), max_range)
    return _project(
        ranges,
        float(scan.angle_min),
        float(scan.angle_increment),
        float(scan.range_min),
        high,
        np.asarray(T_base_laser, dtype=np.float64),
        *arcs_of(sweep),
    )


def warm_up() -> None:
    """Compile the kernel."""
    arcs = np.zeros((1, 3))
    _project(np.ones(2, np.float32), 0.0, 1.0, 0.0, 2.0, np.zeros(3), arcs, arcs)
