# SPDX-License-Identifier: Apache-2.0
"""Reflectors in a scan: bright enough for their range, and of the shape that reflectors have.

A reflector is told from glare, vests and saturated walls by its width, by its depth, and by its
edges: it ends from one beam to the next, while glare fades.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import kernel, part
from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections, Scan

VENDOR_BIT = 65534.0
OCTAVES = 14  # bins of range for the brightness of what is no reflector: 0.125 m to 2 km
NEAREST = 0.125  # [m] where the first octave begins
FALLING = 1.0  # octave from which on brightness falls with range: 0.25 m
BELIEVED = 4.0  # factor by which a farther octave may raise the brightness of a nearer one
EXTENT = 2.0 / 3.0  # share of its threshold down to which a bright spot extends
QUANTILE = 0.75  # of an octave's brightness; glare may take up to a quarter of its beams
MIN_BEAMS = 16  # an octave with fewer beams tells nothing
MAX_WINDOW = 400  # [beams] half a reflector at most, so that the cost is bounded
SAME = 0.1  # [m] between two sightings of one reflector in one sweep
BESIDE = 5  # beams on either side of a spot that tell what it lies in
GAP = 0.02  # [m] a dark gap that does not part a reflector
LIT = 0.8  # share of a cylinder's diameter that shines back at least
TILT = 0.5  # cosine of the widest angle at which a flat reflector is still seen
DARK = 0.6  # beside a reflector, something is less bright than this share of it
EDGE_SHARE = 0.05  # share of a reflector's beams that may belong to its edge
PROFILE = 7  # samples of a beam's profile on either side of its middle
ROUGH = 0.1  # share of its width by which a reflector's surface may be off its shape
SIGMAS = 4.0  # of the noise of a shape
SPACED = 0.5  # reflectors' widths between beams that may well miss a gap beside one
CURVED = 5  # beams that tell a shape
WHOLE = 0.3  # share of its brightness down to which a thing of one depth is one thing
FLATTER = 16.0  # chi^2 by which a thing is flat rather than round: 4 sigma
SUNK = 0.5  # radius by which a cylinder is out of the line of what is beside it at least


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


class Settings(NamedTuple):
    """The parameters as kernels take them; ``extent`` is the threshold's share for all beams."""

    diameter: float
    flat_width: float
    size_tolerance: float
    divergence: float
    edge: float
    min_beams: float
    min_range: float
    max_range: float
    sigma_range: float
    sigma_bearing: float
    sigma_floor: float
    separation: float
    extent: float


@dataclass(frozen=True)
class Found:
    """Reflectors of a scan in the frame of the laser at the time of their own beams.

    ``points`` (n, 2) [m], ``cov`` (n, 2, 2) [m^2]; ``diameters`` (n,) [m], NaN for flat ones;
    ``beams`` (n,) [0, number of beams) of their middles; ``widths`` (n,) [m] as seen;
    ``intensities`` (n,) of their brightest beams. ``rejected`` counts other bright spots by Fate.
    """

    points: Array
    cov: Array
    diameters: Array
    beams: Array
    widths: Array
    intensities: Array
    rejected: dict[Fate, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.points)

    def at_stamp(self, scan: Scan, T_base_laser: Array, sweep: Array) -> Detections:
        """The same as anonymous detections in the frame of the laser at the scan's stamp.

        ``sweep`` (3,) is the motion of base during the whole sweep, at constant twist: what beam
        k of n saw is moved by T_base_laser^-1 exp(k / n log(sweep)) T_base_laser. What a laser
        that turned saw with its first and again with its last beams is told once.
        """
        share = self.beams / max(len(scan.ranges), 1)
        moved = se2.exp(share[:, None] * se2.log(sweep))
        T = se2.between(T_base_laser, se2.compose(moved, T_base_laser))
        R = se2.rotation(T[:, 2])
        points = np.einsum('nij,nj->ni', R, self.points) + T[:, :2]
        cov = np.einsum('nij,njk,nlk->nil', R, self.cov, R)
        apart = np.linalg.norm(points[:, None] - points, axis=-1)
        again = (apart < SAME) & (share[:, None] - share > 0.5)
        once = ~again.any(axis=1)
        ids = np.full(int(once.sum()), ANONYMOUS, dtype=np.int64)
        return Detections(
            scan.stamp, scan.frame_id, points[once], cov[once], ids, self.diameters[once]
        )


def detect(scan: Scan, params: Detector) -> Found:
    """The reflectors of a scan; none where it has no intensities."""
    n = len(scan.ranges)
    if len(scan.intensities) != n or n == 0 or scan.angle_increment == 0.0:
        return _found(scan, np.zeros((0, COLUMNS)))
    ranges, bright, limit = _levels(scan, params)
    rows = _find(
        ranges, bright, limit,
        float(scan.angle_min), float(scan.angle_increment), is_circular(scan),
        _settings(params),
    )  # fmt: skip
    return _found(scan, rows)


def threshold(scan: Scan, params: Detector) -> Array:
    """Intensity (n,) that a reflector's brightest beam exceeds; 0 where nothing returned."""
    return _levels(scan, params)[2]


def is_circular(scan: Scan) -> bool:
    """Whether the last beam's neighbour is the first one."""
    step = abs(scan.angle_increment)
    return step * len(scan.ranges) >= 2.0 * math.pi - 0.5 * step


def _levels(scan: Scan, p: Detector) -> tuple[Array, Array, Array]:
    """Range (0 where nothing returned), intensity and threshold (n,) of each beam."""
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    bright = np.asarray(scan.intensities, dtype=np.float64)
    with np.errstate(invalid='ignore'):
        is_valid = (ranges >= scan.range_min) & (ranges <= scan.range_max) & (ranges > 0.0)
        is_valid &= np.isfinite(bright)
    ranges, bright = np.where(is_valid, ranges, 0.0), np.where(is_valid, bright, 0.0)
    if p.threshold == 'bit':
        limit = np.full(len(ranges), np.nextafter(VENDOR_BIT, 0.0))
    elif p.threshold == 'curve':
        limit = p.a * np.exp(-p.k * ranges) + p.floor
    else:
        step, circular = abs(float(scan.angle_increment)), is_circular(scan)
        level = _other_surfaces(ranges, bright, step, circular, _widest(p))
        limit = np.maximum(p.contrast * level, p.floor)
    return ranges, bright, np.where(is_valid, limit, 0.0)


def _widest(p: Detector) -> float:
    return max(p.diameter, p.flat_width) + p.size_tolerance


def _settings(p: Detector) -> Settings:
    extent = 1.0 if p.threshold == 'bit' else EXTENT
    given = {name: float(getattr(p, name)) for name in Settings._fields if name != 'extent'}
    return Settings(**given, extent=extent)


def _found(scan: Scan, rows: Array) -> Found:
    fates = rows[:, FATE].astype(np.int64)
    counts = np.bincount(fates, minlength=len(Fate))
    rejected = {fate: int(counts[fate]) for fate in Fate if fate and counts[fate]}
    rows = rows[fates == Fate.FOUND]
    u = np.stack([np.cos(rows[:, BEARING]), np.sin(rows[:, BEARING])], -1)
    t = np.stack([-u[:, 1], u[:, 0]], -1)
    r = rows[:, RANGE]
    cov = rows[:, VAR_RANGE, None, None] * u[:, :, None] * u[:, None, :]
    cov += (r**2 * rows[:, VAR_BEARING])[:, None, None] * t[:, :, None] * t[:, None, :]
    return Found(
        r[:, None] * u, cov, rows[:, DIAMETER], rows[:, BEAM] % max(len(scan.ranges), 1),
        rows[:, WIDTH], rows[:, PEAK], rejected,
    )  # fmt: skip


# columns of what a bright spot is
FATE, RANGE, BEARING, VAR_RANGE, VAR_BEARING, DIAMETER, BEAM, WIDTH, PEAK = range(9)
COLUMNS = 9


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


@kernel
def _other_surfaces(
    ranges: Array, bright: Array, step: float, circular: bool, widest: float
) -> Array:
    """Brightness (n,) of bright surfaces as far away as each beam's that are no reflectors.

    A morphological opening along the scan takes away all that is bright and no wider than
    ``widest`` [m], so that it does not matter how many beams reflectors take. Of what is left, an
    upper quantile per octave of range, interpolated over the logarithm of range.
    """
    n = len(ranges)
    half = np.zeros(n, np.int64)
    for k in range(n):
        if ranges[k] > 0.0:
            half[k] = min(int(0.5 * widest / (ranges[k] * step)) + 1, MAX_WINDOW, (n - 1) // 2)
    low = -_window_maximum(-bright, half, circular)
    value = _window_maximum(low, half, circular)
    octave = np.full(n, -1, np.int64)
    for k in range(n):
        if ranges[k] > 0.0 and value[k] > 0.0:
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
def _angle(k: int, n: int, angle_min: float, increment: float) -> float:
    """Direction of beam k; k may pass the end of a full turn, be it of 360 or of 361 beams."""
    turn = 2.0 * math.pi if increment > 0.0 else -2.0 * math.pi
    return angle_min + (k % n) * increment + (k // n) * turn


@kernel
def _find(
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
    start = _angle(first, n, angle_min, increment)
    for k in range(first, last + 1):
        j = k % n
        if not bright[j] > limit[j]:
            continue
        is_bright = is_bright or bright[j] > bound[j]
        beams += 1
        power += bright[j]
        peak = max(peak, bright[j])
        r += bright[j] * ranges[j]
        bearing += bright[j] * (_angle(k, n, angle_min, increment) - start)
        middle += bright[j] * k
    r, bearing, middle = r / power, start + bearing / power, middle / power
    span = r * abs(_angle(last, n, angle_min, increment) - start)
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
    more = _beside(first, last, r, WHOLE * peak, depth, r * step, ranges, bright, circular)
    whole = span + more * r * step
    hidden, fading = _edges(
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
        along[shape], spread[shape] = _centre(
            0.5 * width if shape == 0 else 0.0, first, last, r, bearing, ranges, bright, limit,
            angle_min, increment, footprint,
        )  # fmt: skip
        # at most what noise and the surface's own roughness leave: chi^2 by Wilson and Hilferty
        share = 2.0 / (9.0 * max(beams - 1.0, 1.0))
        noise = settings.sigma_range**2 * (1.0 - share + SIGMAS * math.sqrt(share)) ** 3
        if beams >= CURVED and spread[shape] > noise + (ROUGH * width) ** 2:
            continue
        if shape == 0 and not hidden and _is_flat(
            first, last, r, bearing, beams, spread[0], 0.5 * width, ranges, bright, limit,
            angle_min, increment, circular, settings,
        ):  # fmt: skip
            continue
        # a width that beams this far apart tell to half their spacing
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


@part
def _beside(
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
def _is_flat(
    first: int,
    last: int,
    r: float,
    bearing: float,
    beams: int,
    spread: float,
    radius: float,
    ranges: Array,
    bright: Array,
    limit: Array,
    angle_min: float,
    increment: float,
    circular: bool,
    settings: Settings,
) -> bool:
    """Whether what is bright is a part of a flat surface rather than a cylinder.

    It is where its own ranges tell, ``spread`` being what a cylinder leaves of them; or where it
    lies in a surface that goes on straight at both sides, as paint and glare do: a cylinder
    stands out of what it is fixed to.
    """
    footprint = r * settings.divergence
    _, flat = _centre(
        0.0, first, last, r, bearing, ranges, bright, limit, angle_min, increment, footprint
    )
    variance = settings.sigma_range**2
    better = spread - flat - (ROUGH * radius) ** 2
    if beams >= CURVED and (beams - 1) * better > FLATTER * variance:
        return True
    n = len(ranges)
    # the line through two returns on each side, far enough not to be of a post or a plate that
    # the reflector is a part of
    x, y = np.empty(4), np.empty(4)
    m = 0
    spacing = r * abs(increment)
    clear = max(int(settings.separation / spacing - 0.5 * (last - first)) + 1, 2)
    for side in (-1, 1):
        outer = first if side < 0 else last
        met = 0
        for k in range(clear, clear + BESIDE):
            j = outer + side * k
            if not circular and not 0 <= j < n:
                return False
            if ranges[j % n] <= 0.0:
                continue
            off = _angle(j, n, angle_min, increment) - bearing
            x[m], y[m] = ranges[j % n] * math.sin(off), ranges[j % n] * math.cos(off)
            met, m = met + 1, m + 1
            if met == 2:
                break
        if met < 2:
            return False
    mx, my = np.mean(x), np.mean(y)
    slope = np.sum((x - mx) * (y - my)) / np.sum((x - mx) ** 2)
    off_line = y - my - slope * (x - mx)
    if np.sum(off_line**2) > FLATTER * variance:
        return False
    return bool(abs(my - slope * mx - r) < SUNK * radius)


@part
def _edges(
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
    far = max(reach, min(int(settings.separation / (r * step)), n // 2))
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
        if outside > DARK * inside or inside - outside < settings.edge * (peak - outside):
            fading = True
    return hidden, fading


@part
def _centre(
    radius: float,
    first: int,
    last: int,
    r: float,
    bearing: float,
    ranges: Array,
    bright: Array,
    limit: Array,
    angle_min: float,
    increment: float,
    footprint: float,
) -> tuple[float, float]:
    """Range of the centre, and the variance that beams leave about it and a tilt."""
    n = len(ranges)
    power = mean = squares = 0.0
    sx = sy = sxx = sxy = syy = 0.0
    for k in range(first, last + 1):
        j = k % n
        if not bright[j] > limit[j]:
            continue
        off = _angle(k, n, angle_min, increment) - bearing
        x = r * math.sin(off)
        y = ranges[j] * math.cos(off) + surface_depth(x, 0.5 * footprint, radius)
        # by power: a beam that met the edge alone may have mixed it with what is behind
        w = bright[j]
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
    if sxx > 0.0 and radius == 0.0:
        syy -= sxy * sxy / sxx  # a flat one may be tilted
    freedom = power - squares / power
    return mean / power, max(syy, 0.0) / freedom if freedom > 0.0 else 0.0


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


def warm_up() -> None:
    """Compile the kernels."""
    surface_depth(0.0, 0.1, 0.1)
    ones = np.ones(3, np.float32)
    detect(Scan(1, '', 0.0, 0.1, 0.0, 0.1, 2.0, ones, ones), Detector())
