# SPDX-License-Identifier: Apache-2.0
"""Reflector detection in the intensities of a scan."""

from __future__ import annotations

from dataclasses import dataclass

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class Detector(Group):
    """Reflector detection: a threshold of intensity, and the shape of a bright spot."""

    threshold: str = param(
        'automatic',
        'threshold of intensity: relative to the other surfaces of the scan, a curve '
        'curve_gain exp(-curve_decay r) + floor, or the reflector bit of the vendor (intensity '
        '65534 and more)',
        choices=('automatic', 'curve', 'bit'),
    )
    contrast: float = param(
        5.0,
        'automatic: smallest ratio of the intensity of a reflector to that of other bright '
        'surfaces at the same range',
        '',
        1.1,
        1000.0,
    )
    curve_gain: float = param(
        1000.0, 'curve: part of the threshold that decays, at range 0', '', 0.0, 1e9
    )
    curve_decay: float = param(0.1, 'curve: decay of that part with range', '1/m', 0.0, 100.0)
    intensity_floor: float = param(
        0.0, 'curve and automatic: smallest intensity of a reflector', '', 0.0, 1e9
    )
    diameter: float = param(
        0.08, 'diameter of cylindrical reflectors; 0: there are none', 'm', 0.0, 2.0
    )
    flat_width: float = param(0.0, 'width of flat reflectors; 0: there are none', 'm', 0.0, 2.0)
    size_tolerance: float = param(
        0.025, 'largest error of the measured width of a reflector', 'm', 0.0, 1.0
    )
    divergence: float = param(
        0.003, 'divergence of a beam: full angle at half power', 'rad', 0.0, 0.1
    )
    edge_contrast: float = param(
        0.4,
        'smallest drop of intensity from one beam to the next at both ends of a reflector, '
        'as a share; the glare of a glossy wall fades slowly',
        '',
        0.0,
        1.0,
    )
    min_separation: float = param(
        0.2, 'bright spots closer to each other are parts of a larger object', 'm', 0.0, 10.0
    )
    min_beams: int = param(1, 'smallest number of beams of a reflector', '', 1, 1000)
    min_range: float = param(0.2, 'closer reflectors are not used', 'm', 0.0, 100.0)
    max_range: float = param(40.0, 'farther reflectors are not used', 'm', 0.5, 1000.0)
    sigma_range: float = param(0.01, 'range noise of one beam', 'm', 1e-4, 1.0)
    sigma_bearing: float = param(
        0.0005, 'smallest error of a bearing, however many beams it has', 'rad', 1e-6, 0.1
    )
    sigma_floor: float = param(
        0.003, 'smallest error of a range, however many beams it has', 'm', 1e-5, 1.0
    )
