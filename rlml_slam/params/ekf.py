# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM, and the landmarks that it extracts from a scan."""

from __future__ import annotations

from dataclasses import dataclass

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class Ekf(Group):
    """EKF-SLAM: landmark extraction, association and the filter."""

    extractor: str = param(
        'reflectors',
        'landmarks: reflector detections, or spikes or lines of the scan',
        choices=('reflectors', 'spikes', 'lines'),
    )
    association: str = param(
        'auto',
        'nearest neighbour, joint compatibility, or that with ambiguous matches deferred until '
        'later scans decide; auto: deferred for reflectors, nearest for spikes',
        choices=('auto', 'nearest', 'joint', 'deferred'),
    )
    gate: float = param(0.997, 'probability inside the validation gate', '', 0.5, 0.999999)
    new_gate: float = param(
        0.99999,
        'a detection inside this gate of a landmark never starts a candidate',
        '',
        0.5,
        0.9999999,
    )
    min_separation: float = param(
        0.25, 'a detection closer than this to a landmark never starts a candidate', 'm', 0.0, 20.0
    )
    min_sightings: int = param(3, 'detections before a candidate enters the state', '', 1, 1000)
    candidate_timeout: float = param(
        5.0, 'a candidate without a detection for this long is dropped', 's', 0.01, 1e4
    )
    candidate_sigma: float = param(
        0.5, 'a candidate with a larger sigma relative to the robot is dropped', 'm', 1e-3, 100.0
    )
    range_noise: float = param(
        0.0, 'range noise per range, added to that of the detection', '', 0.0, 1.0
    )
    landmark_sigma: float = param(
        0.0, 'extent of a landmark, 1 sigma, added to the noise of the detection', 'm', 0.0, 10.0
    )
    update: str = param(
        'compressed',
        'update all landmarks each time, or far ones later (compressed EKF)',
        choices=('plain', 'compressed'),
    )
    local_radius: float = param(
        10.0,
        'landmarks closer than this, or within sensor range, are updated at once',
        'm',
        0.5,
        1e4,
    )
    local_margin: float = param(
        5.0, 'travel after which the local region is chosen again', 'm', 0.1, 1e4
    )
    error_model: str = param(
        'invariant',
        'error state: of each coordinate (additive), or invariant to the heading error, which '
        'stays consistent',
        choices=('additive', 'invariant'),
    )
    line_origin: tuple[float, ...] = param(
        (0.0, 0.0), 'fixed point of the map; a line landmark is its point closest to it', 'm, m'
    )
    smooth: bool = param(
        True, 'replay: smooth trajectory and map at the end with all measurements'
    )


@dataclass(frozen=True)
class Spikes(Group):
    """Spike landmarks of a scan."""

    test: str = param(
        'jump',
        'range jump to the neighbours on both sides, or the sum of both differences',
        choices=('jump', 'sum'),
    )
    threshold: float = param(0.5, 'smallest range difference of a spike', 'm', 1e-3, 100.0)
    neighbour_offset: int = param(
        1, 'sum test: distance to the neighbours in valid beams', '', 1, 100
    )
    min_beams: int = param(1, 'smallest number of beams of a spike', '', 1, 1000)
    max_width: float = param(0.3, 'largest width of a spike; a person is wider', 'm', 1e-3, 10.0)
    max_range: float = param(25.0, 'farther spikes are not used', 'm', 0.1, 1000.0)
    cylindrical: bool = param(
        True, 'spikes are cylinders: the centre is pi/8 of the width behind the mean of its ranges'
    )
    range_offset: float = param(
        0.0,
        'added to the range of a spike, against a systematic error of the laser',
        'm',
        -1.0,
        1.0,
    )
    sigma_range: float = param(0.03, 'range noise of a spike', 'm', 1e-4, 10.0)
    sigma_bearing: float = param(0.005, 'bearing noise of a spike', 'rad', 1e-5, 1.0)


@dataclass(frozen=True)
class Ransac(Group):
    """RANSAC lines of a scan; the five parameters of the note are named in brackets."""

    seed: int = param(
        0, 'seed of the samples; the same scan always gives the same lines', '', 0, 2**31
    )
    max_trials: int = param(100, 'largest number of trials (N)', '', 1, 100000)
    samples: int = param(5, 'readings sampled in addition to the first one (S)', '', 1, 100)
    sample_angle: float = param(
        0.17, 'largest angle between a sample and the first reading (D)', 'rad', 1e-3, 3.2
    )
    tolerance: float = param(
        0.04, 'largest distance of a reading from its line (X)', 'm', 1e-4, 10
    )
    consensus: int = param(60, 'smallest number of readings of a line (C)', '', 3, 100000)
    min_length: float = param(1.0, 'smallest length of a line', 'm', 0.0, 100.0)
    max_gap: float = param(
        0.5, 'a line ends at a larger gap between its readings', 'm', 1e-3, 100.0
    )
    sigma: float = param(0.01, 'noise of a reading across its line', 'm', 1e-4, 10.0)
    sigma_floor: tuple[float, ...] = param(
        (0.01, 0.004),
        'smallest error of distance and direction of a line, however many readings it has',
        'm, rad',
        0.0,
        10.0,
    )
