# SPDX-License-Identifier: Apache-2.0
"""The parameters of the reflector detector, a scan and a bright spot as kernels take them."""

from __future__ import annotations

import math
from typing import NamedTuple

from rlml_slam.compiled import part
from rlml_slam.params import Detector
from rlml_slam.se2 import Array

EXTENT = 2.0 / 3.0  # share of its threshold down to which a bright spot extends


class Settings(NamedTuple):
    """The parameters as kernels take them; ``extent`` is the threshold's share for all beams."""

    diameter: float
    flat_width: float
    size_tolerance: float
    divergence: float
    edge_contrast: float
    min_beams: float
    min_range: float
    max_range: float
    sigma_range: float
    sigma_bearing: float
    sigma_floor: float
    min_separation: float
    extent: float


class Beams(NamedTuple):
    """A scan: ``ranges`` (n,) [m], 0 without a return, and intensities ``bright`` (n,).

    A bright spot extends to where they are above ``limit`` (n,).
    """

    ranges: Array
    bright: Array
    limit: Array
    angle_min: float
    increment: float
    circular: bool


class Spot(NamedTuple):
    """A bright spot: beams ``first`` to ``last``, which may pass the end of a full turn.

    ``range``, ``bearing`` and ``middle`` (a beam) are means, ``num`` beams of it are bright,
    ``peak`` is the intensity of the brightest and ``spacing`` [m] the distance between beams.
    """

    first: int
    last: int
    range: float
    bearing: float
    middle: float
    num: int
    peak: float
    spacing: float


@part
def angle_of(k: int, beams: Beams) -> float:
    """Direction of beam k; k may pass the end of a full turn, be it of 360 or of 361 beams."""
    n = len(beams.ranges)
    turn = 2.0 * math.pi if beams.increment > 0.0 else -2.0 * math.pi
    return beams.angle_min + (k % n) * beams.increment + (k // n) * turn


def settings_of(p: Detector) -> Settings:
    """As kernels take them."""
    extent = 1.0 if p.threshold == 'bit' else EXTENT
    given = {name: float(getattr(p, name)) for name in Settings._fields if name != 'extent'}
    return Settings(**given, extent=extent)
