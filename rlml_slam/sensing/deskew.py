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


@brief
def _project(
    ranges: NDArray[np.float32],
    angle_min: float,
    increment: float,
    low: float,
    high: float,
    T_base_laser: Array,
    twist: Array,
) -> Array:
    """End points ``(m, 2)`` of the beams whose range is in [low, high]; NaN and Inf are not.

    ``twist`` is the motion (log) of base during the whole sweep, zero for one without ray times.
    """
    n = len(ranges)
    out = np.empty((n, 2))
    m = 0
    cl, sl = math.cos(T_base_laser[2]), math.sin(T_base_laser[2])
    moving = twist[0] != 0.0 or twist[1] != 0.0 or twist[2] != 0.0
    # (cos, sin) of the beam's angle and of half of the base's turn, each from the beam before:
    # what rounding adds up to over a sweep is a billionth of a beam's noise
    bc, bs = math.cos(angle_min), math.sin(angle_min)
    step_bc, step_bs = math.cos(increment), math.sin(increment)
    ch, sh = 1.0, 0.0
    step_ch, step_sh = math.cos(0.5 * twist[2] / n), math.sin(0.5 * twist[2] / n)
    for k in range(n):
        if k:
            bc, bs = bc * step_bc - bs * step_bs, bs * step_bc + bc * step_bs
            ch, sh = ch * step_ch - sh * step_sh, sh * step_ch + ch * step_sh
        r = float(ranges[k])
        if not (low <= r <= high):
            continue
        px, py = r * bc, r * bs
        x = T_base_laser[0] + cl * px - sl * py
        y = T_base_laser[1] + sl * px + cl * py
        if moving:
            # the sweep is short: midpoint chord instead of the exact arc, error O(w^2)
            f = k / n
            tx = f * (ch * twist[0] - sh * twist[1])
            ty = f * (sh * twist[0] + ch * twist[1])
            c, s = ch * ch - sh * sh, 2.0 * sh * ch
            x, y = tx + c * x - s * y, ty + s * x + c * y
        out[m, 0] = x
        out[m, 1] = y
        m += 1
    return out[:m]


def sweep_time(scan: Scan) -> float:
    """Time [s] from the first ray to one increment after the last."""
    return scan.time_increment * len(scan.ranges)


def project(scan: Scan, T_base_laser: Array, delta: Array, max_range: float) -> Array:
    """Valid end points ``(m, 2)`` of a scan in the base frame at ``scan.stamp``.

    ``delta`` (3,) is the motion of base during :func:`sweep_time`; rays are moved back along the
    constant twist of it. Ranges outside [range_min, min(range_max, max_range)] are left out.
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
        se2.log(delta),
    )


def warm_up() -> None:
    """Compile the kernel."""
    _project(np.ones(2, np.float32), 0.0, 1.0, 0.0, 2.0, np.zeros(3), np.zeros(3))
