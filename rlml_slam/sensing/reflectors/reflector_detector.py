# SPDX-License-Identifier: Apache-2.0
"""Reflectors in a scan: bright enough for their range, and of the shape that reflectors have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.sensing.reflectors.background_intensity import is_circular, levels, opened
from rlml_slam.sensing.reflectors.bright_spots import (
    BEAM,
    BEARING,
    COLUMNS,
    DIAMETER,
    FATE,
    PEAK,
    RANGE,
    VAR_BEARING,
    VAR_RANGE,
    WIDTH,
    Fate,
    find,
)
from rlml_slam.sensing.reflectors.spot_settings import Beams, settings_of
from rlml_slam.sensing.reflectors.spot_shape import surface_depth
from rlml_slam.types import ANONYMOUS, Detections, Scan

SAME = 0.1  # [m] between two sightings of one reflector in one sweep


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
        k of n saw is moved by T_base_laser^-1 exp(k / n log(sweep)) T_base_laser. A reflector
        that a turning laser saw with its first and again with its last beams is returned once.
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


def detect(scan: Scan, params: Detector, floor: Callable[[Array], Array] | None = None) -> Found:
    """The reflectors of a scan; none where it has no intensities.

    ``floor`` has the least threshold by range, where the scans before have shown it.
    """
    n = len(scan.ranges)
    if len(scan.intensities) != n or n == 0 or scan.angle_increment == 0.0:
        return _found(scan, np.zeros((0, COLUMNS)))
    ranges, bright, bound = levels(scan, params, floor)
    settings = settings_of(params)
    beams = Beams(
        ranges, bright, settings.extent * bound,
        float(scan.angle_min), float(scan.angle_increment), is_circular(scan),
    )  # fmt: skip
    return _found(scan, find(beams, bound, settings))


def threshold(scan: Scan, params: Detector) -> Array:
    """Intensity (n,) that a reflector's brightest beam exceeds; 0 where nothing returned."""
    return levels(scan, params)[2]


def _found(scan: Scan, rows: Array) -> Found:
    fates = rows[:, FATE].astype(np.int64)
    counts = np.bincount(fates, minlength=len(Fate))
    rejected = {fate: int(counts[fate]) for fate in Fate if fate and counts[fate]}
    rows = rows[fates == Fate.FOUND]
    u = np.stack([np.cos(rows[:, BEARING]), np.sin(rows[:, BEARING])], -1)
    r = rows[:, RANGE]
    cov = polar_covariance(u, rows[:, VAR_RANGE], r**2 * rows[:, VAR_BEARING])
    return Found(
        r[:, None] * u, cov, rows[:, DIAMETER], rows[:, BEAM] % max(len(scan.ranges), 1),
        rows[:, WIDTH], rows[:, PEAK], rejected,
    )  # fmt: skip


def warm_up() -> None:
    """Compile the kernels."""
    surface_depth(0.0, 0.1, 0.1)
    opened(np.ones(3), np.ones(3), 0.1, False, 0.1)
    ones = np.ones(3, np.float32)
    detect(Scan(1, '', 0.0, 0.1, 0.0, 0.1, 2.0, ones, ones), Detector())
