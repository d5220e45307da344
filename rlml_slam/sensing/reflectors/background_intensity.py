# SPDX-License-Identifier: Apache-2.0
"""How bright a scan is where there are no reflectors: what a reflector has to exceed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

VENDOR_BIT = 65534.0
OCTAVES = 14  # bins of range for the brightness of what is no reflector: 0.125 m to 2 km
NEAREST = 0.125  # [m] where the first octave begins
FALLING = 1.0  # octave from which on brightness falls with range: 0.25 m
BELIEVED = 4.0  # factor by which a farther octave may raise the brightness of a nearer one
QUANTILE = 0.75  # of an octave's brightness; glare may take up to a quarter of its beams
MIN_BEAMS = 16  # an octave with fewer beams is left out
MAX_WINDOW = 400  # [beams] half a reflector at most, so that the cost is bounded


def is_circular(scan: Scan) -> bool:
    """Whether the last beam's neighbour is the first one."""
    step = abs(scan.angle_increment)
    return step * len(scan.ranges) >= 2.0 * math.pi - 0.5 * step


def valid_beams(scan: Scan) -> tuple[Array, Array]:
    """Range and intensity (n,) of each beam, 0 where nothing returned."""
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    bright = np.asarray(scan.intensities, dtype=np.float64)
    with np.errstate(invalid='ignore'):
        is_valid = (ranges >= scan.range_min) & (ranges <= scan.range_max) & (ranges > 0.0)
        is_valid &= np.isfinite(bright)
    return np.where(is_valid, ranges, 0.0), np.where(is_valid, bright, 0.0)


def levels(
    scan: Scan, p: Detector, floor: Callable[[Array], Array] | None = None
) -> tuple[Array, Array, Array]:
    """Range (0 where nothing returned), intensity and threshold (n,) of each beam.

    ``floor`` has the least threshold by range, where the scans before have shown it.
    """
    ranges, bright = valid_beams(scan)
    if p.threshold == 'bit':
        limit = np.full(len(ranges), np.nextafter(VENDOR_BIT, 0.0))
    elif p.threshold == 'curve':
        limit = p.curve_gain * np.exp(-p.curve_decay * ranges) + p.intensity_floor
    else:
        step, circular = abs(float(scan.angle_increment)), is_circular(scan)
        level = _other_surfaces(ranges, bright, step, circular, _widest(p))
        limit = np.maximum(p.contrast * level, p.intensity_floor)
    if floor is not None:
        limit = np.maximum(limit, floor(ranges))
    return ranges, bright, np.where(ranges > 0.0, limit, 0.0)


def _widest(p: Detector) -> float:
    return max(p.diameter, p.flat_width) + p.size_tolerance


@kernel
def opened(ranges: Array, bright: Array, step: float, circular: bool, widest: float) -> Array:
    """Intensity (n,) without all that is bright and no wider than ``widest`` [m].

    A morphological opening along the scan: so it does not matter how many beams reflectors take.
    """
    n = len(ranges)
    half = np.zeros(n, np.int64)
    for k in range(n):
        if ranges[k] > 0.0:
            half[k] = min(int(0.5 * widest / (ranges[k] * step)) + 1, MAX_WINDOW, (n - 1) // 2)
    low = -_window_maximum(-bright, half, circular)
    return _window_maximum(low, half, circular)


@kernel
def _other_surfaces(
    ranges: Array, bright: Array, step: float, circular: bool, widest: float
) -> Array:
    """Brightness (n,) of bright surfaces as far away as each beam's that are no reflectors.

    Of the surfaces that are wider than ``widest`` [m], an upper quantile per octave of range,
    interpolated over the logarithm of range.
    """
    n = len(ranges)
    value = opened(ranges, bright, step, circular, widest)
    octave = np.full(n, -1, np.int64)
    for k in range(n):
        if ranges[k] > 0.0 and (value[k] > 0.0 or bright[k] == 0.0):
            octave[k] = min(int(math.log2(max(ranges[k], NEAREST) / NEAREST)), OCTAVES - 1)
    at = np.empty(OCTAVES)
    level = np.empty(OCTAVES)
    m = 0
    for b in range(OCTAVES):
        inside = value[octave == b]
        if len(inside) >= MIN_BEAMS:
            at[m] = b + 0.5
            level[m] = np.sort(inside)[int(QUANTILE * (len(inside) - 1))]
            m += 1
    # what is nearer is at least as bright, unless the far is glare alone
    for b in range(m - 2, -1, -1):
        if at[b] >= FALLING:
            level[b] = max(level[b], min(level[b + 1], BELIEVED * level[b]))
    out = np.zeros(n)
    if m == 0:  # too few of anything: all of it together
        inside = value[octave >= 0]
        if len(inside):
            out[:] = np.sort(inside)[int(QUANTILE * (len(inside) - 1))]
        return out
    for k in range(n):
        if ranges[k] > 0.0:
            where = math.log2(max(ranges[k], NEAREST) / NEAREST)
            out[k] = np.interp(where, at[:m], level[:m])
    return out


@part
def _window_maximum(values: Array, half: NDArray[np.int64], circular: bool) -> Array:
    """Largest of the values k - half[k] to k + half[k] for every k.

    Two overlapping windows of 2^j values cover any window: O(n log n), whatever the widths are.
    """
    n, margin = len(values), 0
    for k in range(n):
        margin = max(margin, half[k])
    m, levels = n + 2 * margin, 1
    while 2**levels <= 2 * margin + 1:
        levels += 1
    table = np.empty((levels, m))
    for k in range(m):
        inside = margin <= k < margin + n
        table[0, k] = values[(k - margin) % n] if inside or circular else -np.inf
    for j in range(1, levels):
        reach = 2 ** (j - 1)
        for k in range(m - 2 * reach + 1):
            table[j, k] = max(table[j - 1, k], table[j - 1, k + reach])
    log = np.zeros(2 * margin + 2, np.int64)
    for length in range(2, len(log)):
        log[length] = log[length // 2] + 1
    out = np.empty(n)
    for k in range(n):
        j = log[2 * half[k] + 1]
        first, last = margin + k - half[k], margin + k + half[k] + 1
        out[k] = max(table[j, first], table[j, last - 2**j])
    return out
