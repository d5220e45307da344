# SPDX-License-Identifier: Apache-2.0
"""What lies beside a bright spot: more of the same, what hides it, an edge that fades."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import part
from rlml_slam.sensing.reflectors.spot_settings import Beams, Settings, Spot

GAP = 0.02  # [m] a dark gap that does not part a reflector
EDGE_SHARE = 0.05  # share of a reflector's beams that may belong to its edge
DARK = 0.6  # beside a reflector, something is less bright than this share of it


@part
def beside(spot: Spot, beams: Beams, least: float, depth: float) -> int:
    """Beams beside a bright spot that are as far away and brighter than ``least``."""
    n = len(beams.ranges)
    ends = np.zeros(2, np.int64)  # beams more on either side
    for side in range(2):
        for k in range(1, n // 2):
            j = (spot.first - k) if side == 0 else (spot.last + k)
            missed = k - ends[side] - 1
            is_parted = missed > 1 and missed * spot.spacing > GAP
            if is_parted or (not beams.circular and not 0 <= j < n):
                break
            j %= n
            if beams.ranges[j] <= 0.0:
                continue
            if not beams.bright[j] > least or abs(beams.ranges[j] - spot.range) > depth:
                break
            ends[side] = k
    return int(ends[0] + ends[1])


@part
def edges_of(spot: Spot, beams: Beams, depth: float, settings: Settings) -> tuple[int, bool]:
    """How many of its sides something nearer may hide, and whether a free one fades."""
    ranges, bright, n = beams.ranges, beams.bright, len(beams.ranges)
    own = int(EDGE_SHARE * (spot.last - spot.first + 1))
    reach = max(math.ceil(settings.divergence / abs(beams.increment)), 1) + own + 1
    far = max(reach, min(int(settings.min_separation / spot.spacing), n // 2))
    hidden, fading = 0, False
    for side in (-1, 1):
        outer = spot.first if side < 0 else spot.last
        inside, outside = 0.0, np.inf
        is_hidden, met = False, 0
        for k in range(far):
            inner = outer - side * k
            if k < reach and spot.first <= inner <= spot.last:
                inside = max(inside, bright[inner % n])
            j = outer + side * (k + 1)
            if not beams.circular and not 0 <= j < n:
                is_hidden = is_hidden or k == 0
                break
            j %= n
            if ranges[j] <= 0.0:
                continue
            met += 1
            # the first beam beside it may have met both it and what is nearer
            is_hidden = is_hidden or (met <= 2 and ranges[j] < spot.range - depth)
            if k < reach:
                outside = min(outside, bright[j])
            if bright[j] > beams.limit[j] and abs(ranges[j] - spot.range) <= depth:
                fading = True  # a part of something larger
        if is_hidden:
            hidden += 1
            continue
        if outside == np.inf:
            outside = 0.0  # nothing returns from beside it
        least = settings.edge_contrast * (spot.peak - outside)
        if outside > DARK * inside or inside - outside < least:
            fading = True
    return hidden, fading
