# SPDX-License-Identifier: Apache-2.0
"""The shape of a bright spot: where its centre is, and whether it is flat rather than round."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.spot_settings import Beams, Settings, Spot, angle_of

PROFILE = 7  # samples of a beam's profile on either side of its middle
BESIDE = 5  # beams on either side of a spot that are checked for a surface around it
ROUGH = 0.1  # share of its width by which a reflector's surface may be off its shape
CURVED = 5  # least number of beams from which a shape is estimated
FLATTER = 16.0  # chi^2 by which a thing is flat rather than round: 4 sigma
SUNK = 0.5  # radius by which a cylinder is out of the line of what is beside it at least


@part
def is_flat(spot: Spot, beams: Beams, spread: float, radius: float, settings: Settings) -> bool:
    """Whether what is bright is a part of a flat surface rather than a cylinder.

    It is flat if a plane fits its ranges better than a cylinder by FLATTER in chi^2, ``spread``
    being the mean squared residual of the cylinder; or if it lies in a surface that goes on
    straight at both sides, as paint and glare do: a cylinder stands out of what it is fixed to.
    """
    _, flat, _ = centre_of(0.0, spot, beams, settings.divergence)
    variance = settings.sigma_range**2
    better = spread - flat - (ROUGH * radius) ** 2
    if spot.num >= CURVED and (spot.num - 1) * better > FLATTER * variance:
        return True
    x, y = np.empty(4), np.empty(4)
    if not _beside_spot(spot, beams, settings, x, y):
        return False
    mx, my = np.mean(x), np.mean(y)
    slope = np.sum((x - mx) * (y - my)) / np.sum((x - mx) ** 2)
    off_line = y - my - slope * (x - mx)
    if np.sum(off_line**2) > FLATTER * variance:
        return False
    return bool(abs(my - slope * mx - spot.range) < SUNK * radius)


@part
def _beside_spot(spot: Spot, beams: Beams, settings: Settings, x: Array, y: Array) -> bool:
    """Two returns on each side into x and y (4,), across and along; False where there are fewer.

    They are far enough not to be of a post or a plate that the reflector is a part of.
    """
    n, m = len(beams.ranges), 0
    clear = int(settings.min_separation / spot.spacing - 0.5 * (spot.last - spot.first)) + 1
    clear = max(clear, 2)
    for side in (-1, 1):
        outer = spot.first if side < 0 else spot.last
        met = 0
        for k in range(clear, clear + BESIDE):
            j = outer + side * k
            if not beams.circular and not 0 <= j < n:
                return False
            r = beams.ranges[j % n]
            if r <= 0.0:
                continue
            off = angle_of(j, beams) - spot.bearing
            x[m], y[m] = r * math.sin(off), r * math.cos(off)
            met, m = met + 1, m + 1
            if met == 2:
                break
        if met < 2:
            return False
    return True


@part
def centre_of(
    radius: float, spot: Spot, beams: Beams, divergence: float
) -> tuple[float, float, float]:
    """Range of the centre, the variance that beams leave about it, and that about a tilt as well.

    A flat one may be tilted: for it, the first is the second.
    """
    n, r = len(beams.ranges), spot.range
    footprint = r * divergence
    power = mean = squares = 0.0
    sx = sy = sxx = sxy = syy = 0.0
    for k in range(spot.first, spot.last + 1):
        j = k % n
        if not beams.bright[j] > beams.limit[j]:
            continue
        off = angle_of(k, beams) - spot.bearing
        x = r * math.sin(off)
        y = beams.ranges[j] * math.cos(off) + surface_depth(x, 0.5 * footprint, radius)
        # by power: a beam that met the edge alone may have mixed it with what is behind
        w = beams.bright[j]
        power += w
        squares += w * w
        mean += w * y
        y -= r
        sx += w * x
        sy += w * y
        sxx += w * x * x
        sxy += w * x * y
        syy += w * y * y
    sxx -= sx * sx / power
    sxy -= sx * sy / power
    syy -= sy * sy / power
    freedom = power - squares / power
    if freedom <= 0.0:
        return mean / power, 0.0, 0.0
    bent = max(syy - sxy * sxy / sxx, 0.0) if sxx > 0.0 else syy
    return mean / power, (bent if radius == 0.0 else max(syy, 0.0)) / freedom, bent / freedom


@kernel
def surface_depth(x: float, half: float, radius: float) -> float:
    r"""How far before its centre a cylinder's surface is to a beam that passes ``x`` beside it.

    With s(t) = sqrt(radius^2 - t^2), a beam measures the mean of s weighted by the power that
    comes back: the beam's profile times the cosine s / radius, sum w s^2 / sum w s. The profile
    is a raised cosine, half of its peak at ``half`` from the middle. That is s(x) for a thin beam
    and 0.849 radius for a wide one.
    """
    if radius <= 0.0:
        return 0.0
    top = area = 0.0
    for k in range(-PROFILE, PROFILE + 1):
        share = k / (PROFILE + 1.0)
        s = radius * radius - (x + 2.0 * half * share) ** 2
        if s > 0.0:
            w = 1.0 + math.cos(math.pi * share)
            top += w * s
            area += w * math.sqrt(s)
    return top / area if area > 0.0 else 0.0
