# SPDX-License-Identifier: Apache-2.0
"""What lies beside a bright spot: more of the same, what hides it, an edge that fades."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.spot_settings import Settings

GAP = 0.02  # [m] a dark gap that does not part a reflector
EDGE_SHARE = 0.05  # share of a reflector's beams that may belong to its edge
DARK = 0.6  # beside a reflector, something is less bright than this share of it


@part
def angle_of(k: int, n: int, angle_min: float, increment: float) -> float:
    """Direction of beam k; k may pass the end of a full turn, be it of 360 or of 361 beams."""
    turn = 2.0 * math.pi if increment > 0.0 else -2.0 * math.pi
    return angle_min + (k % n) * increment + (k // n) * turn


@part
def beside(
    first: int,
    last: int,
    r: float,
    least: float,
    depth: float,
    spacing: float,
    ranges: Array,
    bright: Array,
    circular: bool,
) -> int:
    """Beams beside a bright spot that are as far away and brighter than ``least``."""
    n = len(ranges)
    ends = np.zeros(2, np.int64)  # beams more on either side
    for side in range(2):
        for k in range(1, n // 2):
            j = (first - k) if side == 0 else (last + k)
            missed = k - ends[side] - 1
            is_parted = missed > 1 and missed * spacing > GAP
            if is_parted or (not circular and not 0 <= j < n):
                break
            j %= n
            if ranges[j] <= 0.0:
                continue
            if not bright[j] > least or abs(ranges[j] - r) > depth:
                break
            ends[side] = k
    return int(ends[0] + ends[1])


@part
def edges_of(
    first: int,
    last: int,
    r: float,
    peak: float,
    ranges: Array,
    bright: Array,
    limit: Array,
    step: float,
    circular: bool,
    depth: float,
    settings: Settings,
) -> tuple[int, bool]:
    """How many of its sides something nearer may hide, and whether a free one fades."""
    n = len(ranges)
    reach = (
        max(math.ceil(settings.divergence / step), 1) + int(EDGE_SHARE * (last - first + 1)) + 1
    )
    far = max(reach, min(int(settings.min_separation / (r * step)), n // 2))
    hidden, fading = 0, False
    for side in (-1, 1):
        outer = first if side < 0 else last
        inside, outside = 0.0, np.inf
        is_hidden, met = False, 0
        for k in range(far):
            inner = outer - side * k
            if k < reach and first <= inner <= last:
                inside = max(inside, bright[inner % n])
            j = outer + side * (k + 1)
            if not circular and not 0 <= j < n:
                is_hidden = is_hidden or k == 0
                break
            j %= n
            if ranges[j] <= 0.0:
                continue
            met += 1
            # the first beam beside it may have met both it and what is nearer
            is_hidden = is_hidden or (met <= 2 and ranges[j] < r - depth)
            if k < reach:
                outside = min(outside, bright[j])
            if bright[j] > limit[j] and abs(ranges[j] - r) <= depth:
                fading = True  # a part of something larger
        if is_hidden:
            hidden += 1
            continue
        if outside == np.inf:
            outside = 0.0  # nothing returns from beside it
        if outside > DARK * inside or inside - outside < settings.edge_contrast * (peak - outside):
            fading = True
    return hidden, fading
