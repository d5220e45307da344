# SPDX-License-Identifier: Apache-2.0
"""Bright spots of a scan, and which of them have the shape of a reflector.

A reflector is distinguished from glare, vests and saturated walls by its width, its depth and
its edges: it ends from one beam to the next, while glare fades.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.spot_edges import GAP, angle_of, beside, edges_of
from rlml_slam.sensing.reflectors.spot_settings import Settings
from rlml_slam.sensing.reflectors.spot_shape import CURVED, ROUGH, centre_of, is_flat

LIT = 0.8  # share of a cylinder's diameter that shines back at least
TILT = 0.5  # cosine of the widest angle at which a flat reflector is still seen
SIGMAS = 4.0  # of the noise of a shape
SPACED = 0.5  # reflectors' widths between beams that may well miss a gap beside one
WHOLE = 0.3  # share of its brightness down to which a thing of one depth is one thing
# columns of what a bright spot is
FATE, RANGE, BEARING, VAR_RANGE, VAR_BEARING, DIAMETER, BEAM, WIDTH, PEAK = range(9)
COLUMNS = 9


class Fate(IntEnum):
    """What became of a bright spot."""

    FOUND = 0
    DIM = 1
    FEW = 2
    RANGE = 3
    HIDDEN = 4
    FADING = 5
    NARROW = 6
    WIDE = 7
    DEEP = 8


@kernel
def find(
    ranges: Array,
    bright: Array,
    bound: Array,
    angle_min: float,
    increment: float,
    circular: bool,
    settings: Settings,
) -> Array:
    """One row per bright spot; ``bound`` (n,) is the threshold of each beam."""
    n = len(ranges)
    step = abs(increment)
    # a bright spot extends to where it falls below a share of the threshold
    limit = settings.extent * bound
    size = max(settings.diameter, settings.flat_width)
    jump = size + settings.size_tolerance + 3.0 * settings.sigma_range
    # bright beams that touch each other, or nearly so
    spans = np.empty((n + 1, 2), np.int64)
    m = 0
    for k in range(n):
        if not bright[k] > limit[k] or ranges[k] <= 0.0:
            continue
        if m > 0:
            last = spans[m - 1, 1]
            is_near = k - last <= 2 or (k - last - 1) * step * ranges[k] <= GAP
            if is_near and abs(ranges[k] - ranges[last]) <= jump:
                spans[m - 1, 1] = k
                continue
        spans[m, 0] = spans[m, 1] = k
        m += 1
    if circular and m > 1:
        first, last = spans[0, 0] + n, spans[m - 1, 1]
        is_near = first - last <= 2 or (first - last - 1) * step * ranges[last] <= GAP
        if is_near and abs(ranges[first - n] - ranges[last]) <= jump:
            spans[m - 1, 1] = spans[0, 1] + n
            spans[0] = spans[m - 1]
            m -= 1
    rows = np.zeros((m, COLUMNS))
    for s in range(m):
        _judge(
            rows[s], spans[s, 0], spans[s, 1], ranges, bright, limit, bound, angle_min, increment,
            circular, settings,
        )  # fmt: skip
    return rows


@part
def _judge(
    row: Array,
    first: int,
    last: int,
    ranges: Array,
    bright: Array,
    limit: Array,
    bound: Array,
    angle_min: float,
    increment: float,
    circular: bool,
    settings: Settings,
) -> None:
    """What the bright spot of beams ``first`` to ``last`` is."""
    n = len(ranges)
    step = abs(increment)
    diameter, flat = settings.diameter, settings.flat_width
    # means weighted by received power: whatever the width of the beam, those over all beams are
    # the means over the surface
    beams, power, peak = 0, 0.0, 0.0
    is_bright = False
    r = bearing = middle = 0.0
    start = angle_of(first, n, angle_min, increment)
    for k in range(first, last + 1):
        j = k % n
        if not bright[j] > limit[j]:
            continue
        is_bright = is_bright or bright[j] > bound[j]
        beams += 1
        power += bright[j]
        peak = max(peak, bright[j])
        r += bright[j] * ranges[j]
        bearing += bright[j] * (angle_of(k, n, angle_min, increment) - start)
        middle += bright[j] * k
    r, bearing, middle = r / power, start + bearing / power, middle / power
    span = r * abs(angle_of(last, n, angle_min, increment) - start)
    row[RANGE], row[BEARING], row[BEAM], row[PEAK] = r, bearing, middle, peak
    row[WIDTH] = span + r * step
    if not is_bright:
        row[FATE] = Fate.DIM.value
        return
    if beams < settings.min_beams:
        row[FATE] = Fate.FEW.value
        return
    if r < settings.min_range or r > settings.max_range:
        row[FATE] = Fate.RANGE.value
        return
    depth = 0.5 * max(diameter, flat) + 3.0 * settings.sigma_range
    # whatever is as far away and not much darker belongs to it
    more = beside(first, last, r, WHOLE * peak, depth, r * step, ranges, bright, circular)
    whole = span + more * r * step
    hidden, fading = edges_of(
        first, last, r, peak, ranges, bright, limit, step, circular,
        depth, settings,
    )  # fmt: skip
    # glare that something cuts off looks like a reflector that something hides; where beams lie
    # far apart, what is nearer may also stand beside it
    if hidden == 2 or (hidden and r * step < SPACED * max(diameter, flat)):
        row[FATE] = Fate.HIDDEN.value
        return
    if fading:
        row[FATE] = Fate.FADING.value
        return
    footprint = r * settings.divergence
    spacing = r * step
    weights, total = np.zeros(2), 0.0
    along, spread = np.zeros(2), np.zeros(2)
    narrow, wide = True, True
    for shape in range(2):
        width = diameter if shape == 0 else flat
        if width <= 0.0:
            continue
        least = (LIT if shape == 0 else TILT) * width - settings.size_tolerance
        is_narrow = span + 2.0 * spacing < least
        is_wide = whole - footprint > width + settings.size_tolerance
        narrow, wide = narrow and is_narrow, wide and is_wide
        if is_narrow or is_wide:
            continue
        along[shape], spread[shape] = centre_of(
            0.5 * width if shape == 0 else 0.0, first, last, r, bearing, ranges, bright, limit,
            angle_min, increment, footprint,
        )  # fmt: skip
        # at most what noise and the surface's own roughness leave: chi^2 by Wilson and Hilferty
        share = 2.0 / (9.0 * max(beams - 1.0, 1.0))
        noise = settings.sigma_range**2 * (1.0 - share + SIGMAS * math.sqrt(share)) ** 3
        if beams >= CURVED and spread[shape] > noise + (ROUGH * width) ** 2:
            continue
        if shape == 0 and not hidden and is_flat(
            first, last, r, bearing, beams, spread[0], 0.5 * width, ranges, bright, limit,
            angle_min, increment, circular, settings,
        ):  # fmt: skip
            continue
        # each of the two edges is uniform within one spacing of beams: variance spacing^2 / 12
        var_width = spacing**2 / 6.0 + (0.5 * settings.size_tolerance) ** 2 + 1e-12
        weights[shape] = math.exp(-0.5 * (row[WIDTH] - width) ** 2 / var_width) + 1e-9
        total += weights[shape]
    if total == 0.0:
        fate = Fate.NARROW if narrow else (Fate.WIDE if wide else Fate.DEEP)
        row[FATE] = fate.value
        return
    mean = (weights[0] * along[0] + weights[1] * along[1]) / total
    between = weights[0] * weights[1] / total**2 * (along[0] - along[1]) ** 2
    width = diameter if weights[0] >= weights[1] else flat
    row[RANGE] = mean
    row[VAR_RANGE] = settings.sigma_range**2 / beams + settings.sigma_floor**2 + between
    # the middle of samples that lie ``spacing`` apart; one alone lies anywhere on the reflector
    across = min(spacing, width + footprint) ** 2 / 12.0 / beams
    if hidden:
        across += width**2 / 12.0
    row[VAR_BEARING] = across / mean**2 + settings.sigma_bearing**2
    row[DIAMETER] = diameter if weights[0] >= weights[1] else np.nan
