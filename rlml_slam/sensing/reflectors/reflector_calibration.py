# SPDX-License-Identifier: Apache-2.0
"""What reflectors look like to a laser, found in its scans: how bright, how wide, how sharp.

A retro-reflector sends back to the laser what falls on it, a hundred times as much as the whitest
wall, and it is small. So what is diffuse is learned from surfaces wider than any reflector, over
all scans and by range; small spots that are far brighter than all of it at their range are
reflectors, if there are any. The scale of the intensities does not matter: only ratios count, and
a laser that has a few levels, of which 0 is for everything diffuse, has a ratio without bound.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.background_intensity import (
    MIN_BEAMS,
    NEAREST,
    OCTAVES,
    is_circular,
    opened,
    valid_beams,
)
from rlml_slam.sensing.reflectors.bright_spots import (
    BEAM,
    BEARING,
    FATE,
    PEAK,
    RANGE,
    WIDTH,
    Fate,
    find,
)
from rlml_slam.sensing.reflectors.reflector_size import DIVERGENCES, WIDEST, ReflectorSize
from rlml_slam.sensing.reflectors.spot_settings import Beams, settings_of
from rlml_slam.types import Scan

FINE = 8  # bins of an octave of intensity
BINS = 32 * FINE  # of intensity; from 2^-8 to 2^24 times the first one
LOWEST = 2.0**-8
DIFFUSE = 0.98  # quantile of the intensity of wide surfaces: the whitest of them, without glare
NEARER = 1.5  # times as bright as nearer ones is a diffuse surface at most; more is glare
FULL = 4  # octave from which on diffuse light falls with range: 2 m
STANDS_OUT = 2.5  # least ratio of a reflector to that
NOISE = 7.0  # sigmas of noisy intensities; half of them are between a wide surface and its darkest
MOST_NOISE = 6.0  # logarithm of what noise may ask for: within the bounds of the contrast
BELOW = 0.75  # share of the ratio of dim reflectors at which the threshold is
SCANS = 200  # newest ones whose range noise is remembered
SPOTS = 2000  # newest bright spots that are remembered
ENOUGH_SPOTS, ENOUGH_SCANS = 12, 8  # before anything is said
PERIOD = 25  # scans between two estimates
NOISY = 0.05  # [m] of range noise at most
TOLERANCE = 0.3  # of the size, by which it may be off


@dataclass(frozen=True)
class Calibration:
    """The detector's parameters for a laser, and the diffuse intensity (OCTAVES,) by range.

    ``ratio`` is how many times as bright as that the dimmest tenth of the reflectors is, infinite
    where all else has no intensity at all. ``sigma_size`` [m] is how well their size is known.
    """

    detector: Detector
    diffuse: Array
    ratio: float
    sigma_size: float

    def floor(self, ranges: Array) -> Array:
        """Intensity (n,) below which nothing at these ranges is a reflector."""
        return self.detector.contrast * diffuse_at(self.diffuse, ranges)


def diffuse_at(diffuse: Array, ranges: Array) -> Array:
    """Diffuse intensity (n,) at ranges, interpolated over their logarithm."""
    at = np.log2(np.maximum(ranges, NEAREST) / NEAREST)
    return np.interp(at, np.arange(OCTAVES) + 0.5, diffuse)


class ReflectorCalibration:
    """Collects the scans of one laser; ``result`` is None as long as nothing stands out."""

    def __init__(self, params: Detector) -> None:
        self._p = params
        # wide surfaces are what is left when everything narrower than this is taken away
        self._search = replace(
            params, diameter=WIDEST, flat_width=0.0, contrast=STANDS_OUT, min_beams=1,
            divergence=float(DIVERGENCES[-1]),
        )  # fmt: skip
        self._counts = np.zeros((OCTAVES, BINS + 1), np.int64)
        self._spots: deque[tuple[float, float]] = deque(maxlen=SPOTS)  # range and peak
        self._size = ReflectorSize(max(params.diameter, params.flat_width), params.divergence)
        self._noise: deque[float] = deque(maxlen=SCANS)  # [m] of the newest scans
        self._speckle: deque[float] = deque(maxlen=SCANS)  # the same of the log of intensities
        self.num_scans = 0
        self.result: Calibration | None = None

    def add(self, scan: Scan, T_odom_laser: Array | None = None) -> None:
        """One scan with intensities, from a pose (3,) in odom; now and then a new estimate."""
        step = abs(float(scan.angle_increment))
        if not step > 0.0:  # also true for NaN
            return
        self.num_scans += 1
        ranges, bright = valid_beams(scan)
        self._noise.append(range_noise(ranges))
        self._speckle.append(intensity_noise(bright))
        surface = opened(ranges, bright, step, is_circular(scan), WIDEST)
        octaves = octave_of(ranges)
        seen = octaves >= 0
        # next to beams without a return the width of what is bright is not known
        wide = seen & ((surface > 0.0) | (bright == 0.0))
        np.add.at(self._counts, (octaves[wide], bin_of(surface)[wide]), 1)
        bound = self._stands_out() * diffuse_at(self._diffuse(), ranges)
        settings = settings_of(self._search)
        beams = Beams(
            ranges, bright, settings.extent * np.where(seen, bound, 0.0), float(scan.angle_min),
            float(scan.angle_increment), is_circular(scan),
        )  # fmt: skip
        rows = find(beams, np.where(seen, bound, 0.0), settings)
        fates = rows[:, FATE].astype(np.int64)
        small = ~np.isin(fates, (Fate.DIM, Fate.FEW, Fate.RANGE, Fate.HIDDEN, Fate.FADING))
        rows = rows[small & (rows[:, WIDTH] < WIDEST + rows[:, RANGE] * DIVERGENCES[-1])]
        r, bearing = rows[:, RANGE], rows[:, BEARING]
        self._spots.extend(zip(r, rows[:, PEAK], strict=True))
        points = r[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        spots = np.stack([r, rows[:, WIDTH], r * step, rows[:, BEAM]], -1)
        pose = np.zeros(3) if T_odom_laser is None else T_odom_laser
        self._size.add(scan.stamp, points, pose, spots)
        if self.num_scans >= ENOUGH_SCANS and self.num_scans % PERIOD in (0, ENOUGH_SCANS):
            self.result = self.estimate()

    def _diffuse(self) -> Array:
        """The whitest of the wide surfaces (OCTAVES,); nearer ones are at least as bright."""
        total = self._counts.sum(axis=1)
        above = np.cumsum(self._counts, axis=1) >= DIFFUSE * total[:, None]
        level = np.where(total >= MIN_BEAMS, intensity_of(np.argmax(above, axis=1)), np.nan)
        known = np.isfinite(level)
        if not known.any():  # an open field, with nothing but small things in it
            return np.zeros(OCTAVES)
        at, level = np.flatnonzero(known), level[known]
        # the first octaves may be nearer than where the lens sees all of the spot
        brightest = np.maximum.accumulate(np.where(at < FULL, 0.0, level))
        nearer = np.concatenate([[np.inf], brightest[:-1]])
        level = np.where(at > FULL, np.minimum(level, NEARER * nearer), level)
        return np.interp(np.arange(OCTAVES), at, level)

    def _stands_out(self) -> float:
        """Least ratio of a reflector to what is diffuse: none is noise."""
        noise = math.exp(min(NOISE * float(np.median(self._speckle or 0.0)), MOST_NOISE))
        return max(STANDS_OUT, noise)

    def estimate(self) -> Calibration | None:
        """What the spots have in common, None if they are too few."""
        least = self._stands_out()
        spots, diffuse = np.array(self._spots).reshape(-1, 2), self._diffuse()
        level = diffuse_at(diffuse, spots[:, 0])
        ratios = np.where(level > 0.0, spots[:, 1] / np.maximum(level, 1e-300), np.inf)
        out = ratios >= least
        if out.sum() < max(ENOUGH_SPOTS, 0.02 * self.num_scans):
            return None
        ratio = float(np.quantile(ratios[out], 0.1, method='lower'))
        size, divergence, sigma = self._size.estimate()
        # below the dimmest reflectors, and as far above everything white as they allow
        contrast = min(max(self._p.contrast, least), max(math.sqrt(ratio), BELOW * ratio, least))
        if math.isinf(ratio):  # nothing diffuse returns, whose noise that would be
            contrast = self._p.contrast
        detector = replace(
            self._p, contrast=contrast, divergence=divergence,
            sigma_range=max(self._p.sigma_range, min(float(np.median(self._noise)), NOISY)),
            size_tolerance=max(self._p.size_tolerance, TOLERANCE * size),
            # next to what has no intensity, every edge is sharp
            edge_contrast=0.0 if math.isinf(ratio) else self._p.edge_contrast,
        )  # fmt: skip
        # each reflector shows by itself which of both shapes it has, unless all are flat
        diameter, flat_width = size if self._p.diameter > 0.0 else 0.0, size
        if self._p.diameter > 0.0 and self._p.flat_width > 0.0:
            diameter, flat_width, sigma = self._p.diameter, self._p.flat_width, 0.0
        detector = replace(detector, diameter=diameter, flat_width=flat_width)
        return Calibration(detector, diffuse, ratio, sigma)


def calibrated(scans: Iterable[Scan], params: Detector) -> Calibration | None:
    """What all of the scans of a laser show, None if nothing stands out."""
    calibration = ReflectorCalibration(params)
    for scan in scans:
        calibration.add(scan)
    return calibration.estimate()


def range_noise(ranges: Array) -> float:
    """Range noise [m] of a scan: what neighbouring beams (n,) differ by where a surface goes on.

    The second difference of three beams of variance sigma^2 has the variance 6 sigma^2, and on a
    straight wall next to no mean; its median does not see edges.
    """
    met = (ranges[:-2] > 0.0) & (ranges[1:-1] > 0.0) & (ranges[2:] > 0.0)
    if met.sum() < MIN_BEAMS:
        return 0.0
    bent = np.abs(ranges[:-2] - 2.0 * ranges[1:-1] + ranges[2:])[met]
    return float(np.median(bent)) / (0.6745 * math.sqrt(6.0))


def intensity_noise(bright: Array) -> float:
    """Noise of the logarithm of intensities (n,): what neighbouring beams differ by."""
    log = np.log(bright[bright > 0.0])
    if len(log) < MIN_BEAMS:
        return 0.0
    return float(np.median(np.abs(np.diff(log)))) / (0.6745 * math.sqrt(2.0))


def octave_of(ranges: Array) -> NDArray[np.int64]:
    """Octave of range (n,) of each beam, -1 where nothing returned."""
    octave = np.log2(np.maximum(ranges, NEAREST) / NEAREST).astype(np.int64)
    return np.where(ranges > 0.0, np.minimum(octave, OCTAVES - 1), -1)


def bin_of(bright: Array) -> NDArray[np.int64]:
    """Bin of intensity, logarithmic; 0 is darkness."""
    fine = np.floor(FINE * np.log2(np.maximum(bright, LOWEST) / LOWEST)).astype(np.int64) + 1
    return np.where(bright > LOWEST, np.minimum(fine, BINS), 0)


def intensity_of(bins: NDArray[np.int64]) -> Array:
    """Upper end of a bin of intensity, 0 of darkness."""
    return np.where(bins > 0, LOWEST * 2.0 ** (bins / FINE), 0.0)
