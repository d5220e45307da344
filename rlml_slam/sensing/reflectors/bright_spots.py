# SPDX-License-Identifier: Apache-2.0
"""Bright spots of a scan, and which of them have the shape of a reflector.

A reflector is distinguished from glare, vests and saturated walls by its width, its depth and
its edges: it ends from one beam to the next, while glare fades.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.spot_edges import GAP, beside, edges_of
from rlml_slam.sensing.reflectors.spot_settings import Beams, Settings, Spot, angle_of
from rlml_slam.sensing.reflectors.spot_shape import CURVED, ROUGH, centre_of, is_flat

# Reflective film returns little beyond an incidence of 50 to 60 degrees: a cylinder shines over at
# least sin(53 deg) of its diameter, and a flat one that is turned by 60 degrees is half as wide.
LIT, TILT = 0.8, 0.5
SIGMAS = 4.0  # of the noise of a shape: 3 of 100 000 reflectors are noisier
SPACED = 0.5  # reflectors' widths between beams that may well miss a gap beside one
WHOLE = 0.3  # share of its brightness down to which a thing of one depth is one thing
# columns of what a bright spot is
FATE, RANGE, BEARING, VAR_RANGE, VAR_BEARING, ODDS, BEAM, WIDTH, PEAK, ROUND, FLAT, TILTED = range(
    12
)
COLUMNS = 12
SURE = 20.0  # log of the odds of a shape where the other one does not fit
Ints = NDArray[np.int64]


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
def find(beams: Beams, bound: Array, settings: Settings) -> Array:
    """One row per bright spot; ``bound`` (n,) is the threshold of each beam."""
    size = max(settings.diameter, settings.flat_width)
    spans = _spans(beams, size + settings.size_tolerance + 3.0 * settings.sigma_range)
    rows = np.zeros((len(spans), COLUMNS))
    for s in range(len(spans)):
        rows[s, FATE] = _examine(rows[s], spans[s, 0], spans[s, 1], beams, bound, settings).value
    return rows


@part
def _spans(beams: Beams, jump: float) -> Ints:
    """First and last of bright beams (m, 2) that touch each other, or nearly so."""
    ranges, n, step = beams.ranges, len(beams.ranges), abs(beams.increment)
    spans = np.empty((n + 1, 2), np.int64)
    m = 0
    for k in range(n):
        if not beams.bright[k] > beams.limit[k] or ranges[k] <= 0.0:
            continue
        if m > 0:
            last = spans[m - 1, 1]
            is_near = k - last <= 2 or (k - last - 1) * step * ranges[k] <= GAP
            if is_near and abs(ranges[k] - ranges[last]) <= jump:
                spans[m - 1, 1] = k
                continue
        spans[m, 0] = spans[m, 1] = k
        m += 1
    if beams.circular and m > 1:
        first, last = spans[0, 0] + n, spans[m - 1, 1]
        is_near = first - last <= 2 or (first - last - 1) * step * ranges[last] <= GAP
        if is_near and abs(ranges[first - n] - ranges[last]) <= jump:
            spans[m - 1, 1] = spans[0, 1] + n
            spans[0] = spans[m - 1]
            m -= 1
    return spans[:m]


@part
def _spot_of(first: int, last: int, beams: Beams, bound: Array) -> tuple[Spot, bool]:
    """The bright spot of beams ``first`` to ``last``, and whether one exceeds its bound.

    Means are weighted by received power: whatever the width of the beam, those over all beams are
    the means over the surface.
    """
    n, num, power, peak = len(beams.ranges), 0, 0.0, 0.0
    is_bright = False
    r = bearing = middle = 0.0
    start = angle_of(first, beams)
    for k in range(first, last + 1):
        j = k % n
        if not beams.bright[j] > beams.limit[j]:
            continue
        is_bright = is_bright or beams.bright[j] > bound[j]
        num += 1
        power += beams.bright[j]
        peak = max(peak, beams.bright[j])
        r += beams.bright[j] * beams.ranges[j]
        bearing += beams.bright[j] * (angle_of(k, beams) - start)
        middle += beams.bright[j] * k
    r = r / power
    spacing = r * abs(beams.increment)
    return Spot(
        first, last, r, start + bearing / power, middle / power, num, peak, spacing
    ), is_bright


@part
def _examine(
    row: Array, first: int, last: int, beams: Beams, bound: Array, settings: Settings
) -> Fate:
    """What the bright spot of beams ``first`` to ``last`` is."""
    spot, is_bright = _spot_of(first, last, beams, bound)
    span = spot.range * abs(angle_of(last, beams) - angle_of(first, beams))
    row[RANGE], row[BEARING] = spot.range, spot.bearing
    row[BEAM], row[PEAK] = spot.middle, spot.peak
    row[WIDTH] = span + spot.spacing
    if not is_bright:
        return Fate.DIM
    if spot.num < settings.min_beams:
        return Fate.FEW
    if spot.range < settings.min_range or spot.range > settings.max_range:
        return Fate.RANGE
    size = max(settings.diameter, settings.flat_width)
    depth = 0.5 * size + 3.0 * settings.sigma_range
    hidden, fading = edges_of(spot, beams, depth, settings)
    # glare that something cuts off looks like a reflector that something hides; where beams lie
    # far apart, what is nearer may also stand beside it
    if hidden == 2 or (hidden and spot.spacing < SPACED * size):
        return Fate.HIDDEN
    if fading:
        return Fate.FADING
    # whatever is as far away and not much darker belongs to it
    whole = span + beside(spot, beams, WHOLE * spot.peak, depth) * spot.spacing
    return _place(row, spot, beams, span, whole, hidden > 0, settings)


@part
def _place(
    row: Array, spot: Spot, beams: Beams, span: float, whole: float, hidden: bool,
    settings: Settings,
) -> Fate:  # fmt: skip
    """Range to the centre by shape, the log of the odds of flat against round, and variances.

    Into ``row``; or why no shape fits. ODDS are those of the width, and of the ranges about any
    tilt; TILTED those of the tilt, which is 0 for a cylinder and of variance 1 for a flat one.
    """
    footprint, spacing = spot.range * settings.divergence, spot.spacing
    size = max(settings.diameter, settings.flat_width)
    log_fit = np.full(2, -np.inf)
    along, spread, bent = np.zeros(2), np.zeros(2), np.zeros(2)
    narrow, wide = True, True
    for shape in range(2):
        width = settings.diameter if shape == 0 else settings.flat_width
        if width <= 0.0:
            continue
        least = (LIT if shape == 0 else TILT) * width - settings.size_tolerance
        is_narrow = span + 2.0 * spacing < least
        is_wide = whole - footprint > width + settings.size_tolerance
        narrow, wide = narrow and is_narrow, wide and is_wide
        if is_narrow or is_wide:
            continue
        radius = 0.5 * width if shape == 0 else 0.0
        along[shape], spread[shape], bent[shape] = centre_of(
            radius, spot, beams, settings.divergence
        )
        if spot.num >= CURVED and spread[shape] > _noise(spot, settings) + (ROUGH * width) ** 2:
            continue
        if shape == 0 and not hidden and is_flat(spot, beams, spread[0], radius, settings):
            continue
        # each of the two edges is uniform within one spacing of beams: variance spacing^2 / 12
        var_width = spacing**2 / 6.0 + (0.5 * settings.size_tolerance) ** 2 + 1e-12
        rough = settings.sigma_range**2 + (ROUGH * width) ** 2
        log_fit[shape] = (
            -0.5 * (row[WIDTH] - width) ** 2 / var_width
            - 0.5 * (spot.num - 1) * bent[shape] / rough
        )
    if log_fit[0] > -np.inf and log_fit[1] > -np.inf:
        rough = settings.sigma_range**2 + (ROUGH * size) ** 2
        info = spacing**2 * spot.num * (spot.num**2 - 1.0) / 12.0 / rough
        squares = (spot.num - 1) * (spread[0] - bent[0]) / rough
        row[TILTED] = 0.5 * (squares * info / (1.0 + info) - math.log(1.0 + info))
    best = max(log_fit[0], log_fit[1])
    if best == -np.inf:
        return Fate.NARROW if narrow else (Fate.WIDE if wide else Fate.DEEP)
    row[ODDS] = max(-SURE, min(SURE, log_fit[1] - log_fit[0]))
    row[ROUND] = along[0] if log_fit[0] > -np.inf else along[1]
    row[FLAT] = along[1] if log_fit[1] > -np.inf else along[0]
    row[VAR_RANGE] = settings.sigma_range**2 / spot.num + settings.sigma_floor**2
    is_round = row[ODDS] + row[TILTED] <= 0.0
    width = settings.diameter if is_round else settings.flat_width
    mean = row[ROUND] if is_round else row[FLAT]
    # the middle of samples that lie ``spacing`` apart; one alone lies anywhere on the reflector
    across = min(spacing, width + footprint) ** 2 / 12.0 / spot.num
    if hidden:
        across += width**2 / 12.0
    row[VAR_BEARING] = across / mean**2 + settings.sigma_bearing**2
    return Fate.FOUND


@part
def _noise(spot: Spot, settings: Settings) -> float:
    """Bound of the mean square that noise leaves: of chi^2, by Wilson and Hilferty."""
    share = 2.0 / (9.0 * max(spot.num - 1.0, 1.0))
    return settings.sigma_range**2 * (1.0 - share + SIGMAS * math.sqrt(share)) ** 3
