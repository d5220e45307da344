# SPDX-License-Identifier: Apache-2.0
"""The parameters of the reflector detector as kernels take them."""

from __future__ import annotations

from typing import NamedTuple

from rlml_slam.params import Detector

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


def settings_of(p: Detector) -> Settings:
    """As kernels take them."""
    extent = 1.0 if p.threshold == 'bit' else EXTENT
    given = {name: float(getattr(p, name)) for name in Settings._fields if name != 'extent'}
    return Settings(**given, extent=extent)
