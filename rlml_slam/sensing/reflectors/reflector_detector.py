# SPDX-License-Identifier: Apache-2.0
"""Reflectors in a scan: bright enough for their range, and of the shape that reflectors have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import base_at
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.sensing.reflectors.background_intensity import (
    is_circular,
    levels,
    opened,
    valid_beams,
)
from rlml_slam.sensing.reflectors.bright_spots import (
    BEAM,
    BEARING,
    COLUMNS,
    FATE,
    FLAT,
    ODDS,
    PEAK,
    ROUND,
    TILTED,
    VAR_BEARING,
    VAR_RANGE,
    WIDTH,
    Fate,
    find,
)
from rlml_slam.sensing.reflectors.spot_settings import Beams, settings_of
from rlml_slam.sensing.reflectors.spot_shape import surface_depth
from rlml_slam.types import ANONYMOUS, Detections, Scan

# of a diameter: the mean of sqrt(R^2 - t^2) weighted by the power that comes back, 8 R / (3 pi)
DEPTH = 4.0 / (3.0 * np.pi)
SAME = 0.1  # [m] between two sightings of one reflector in one sweep
MAX_LASERS = 16  # of a robot
FEWEST, MOST = 30, 0.8  # beams of a scan, share of them with the least intensity where it marks


@dataclass(frozen=True)
class Found:
    """Reflectors of a scan in the frame of the laser at the time of their own beams.

    ``points`` (n, 2) [m], ``cov`` (n, 2, 2) [m^2]; ``diameters`` (n,) [m], NaN for flat ones;
    ``beams`` (n,) [0, number of beams) of their middles; ``widths`` (n,) [m] as seen;
    ``intensities`` (n,) of their brightest beams; ``odds`` (n,) the logarithm of the odds that
    they are flat. ``rejected`` counts other bright spots by Fate.
    """

    points: Array
    cov: Array
    diameters: Array
    beams: Array
    widths: Array
    intensities: Array
    odds: Array
    rejected: dict[Fate, int] = field(default_factory=dict)
    rows: Array = field(default_factory=lambda: np.zeros((0, COLUMNS)), repr=False)

    def __len__(self) -> int:
        return len(self.points)

    def with_odds(
        self, odds: Array, diameter: float, shared: float = 1.0, sigma_size: float = 0.0
    ) -> Found:
        """The same where the odds of the shapes (n,) are better known.

        The range is the mean over the shapes, and its variance has what they differ by: with the
        share f of flat, f (1 - f) (r_flat - r_round)^2, times the scans that it is ``shared`` by.
        So has what is open about the diameter, ``sigma_size`` [m], of which a cylinder's surface
        is DEPTH on average before its centre.
        """
        rows, flat = self.rows, 1.0 / (1.0 + np.exp(-odds))
        r = rows[:, ROUND] + flat * (rows[:, FLAT] - rows[:, ROUND])
        u = np.stack([np.cos(rows[:, BEARING]), np.sin(rows[:, BEARING])], -1)
        open_shape = flat * (1.0 - flat) * (rows[:, FLAT] - rows[:, ROUND]) ** 2
        open_size = (1.0 - flat) * (DEPTH * sigma_size) ** 2
        var = rows[:, VAR_RANGE] + shared * (open_shape + open_size)
        cov = polar_covariance(u, var, r**2 * rows[:, VAR_BEARING])
        diameters = np.where(odds > 0.0, np.nan, diameter)
        return replace(self, points=r[:, None] * u, cov=cov, diameters=diameters, odds=odds)

    def at_stamp(
        self,
        scan: Scan,
        T_base_laser: Array,
        sweep: Array,
        sweep_cov: Array | None = None,
        once: bool = True,
    ) -> Detections:
        """The same as anonymous detections in the frame of the laser at the scan's stamp.

        ``sweep`` (a, 3) is the motion of base during the sweep, by arcs: what beam k of n saw is
        moved by T_base_laser^-1 X T_base_laser with the pose X of base then (eq. 70), and is off
        by k / n of the error of all of ``sweep``, whose covariance is ``sweep_cov`` (3, 3). A
        reflector that a turning laser saw with its first and again with its last beams is returned
        once.
        """
        share = self.beams / max(len(scan.ranges), 1)
        T = se2.between(T_base_laser, se2.compose(base_at(sweep, share), T_base_laser))
        R = se2.rotation(T[:, 2])
        points = np.einsum('nij,nj->ni', R, self.points) + T[:, :2]
        cov = np.einsum('nij,njk,nlk->nil', R, self.cov, R)
        if sweep_cov is not None:
            J = _turned_by_sweep(points, T_base_laser, share)
            cov = cov + J @ sweep_cov @ J.transpose(0, 2, 1)
        apart = np.linalg.norm(points[:, None] - points, axis=-1)
        again = (apart < SAME) & (share[:, None] - share > 0.5)
        kept = ~(once & again.any(axis=1))
        ids = np.full(int(kept.sum()), ANONYMOUS, dtype=np.int64)
        return Detections(
            scan.stamp, scan.frame_id, points[kept], cov[kept], ids, self.diameters[kept]
        )


def _turned_by_sweep(points: Array, T_base_laser: Array, share: Array) -> Array:
    """Jacobian (n, 2, 3) of points (n, 2) in the laser's frame with respect to the sweep."""
    p = se2.transform(T_base_laser, points)
    J = np.zeros((len(points), 2, 3))
    J[:, :, :2] = np.eye(2)
    J[:, 0, 2], J[:, 1, 2] = -p[:, 1], p[:, 0]
    return share[:, None, None] * (se2.rotation(T_base_laser[2]).T @ J)


class IntensityCheck:
    """Whether the intensities of scans show anything, be it that no reflector is there.

    To a laser that marks reflectors, or has a few levels of intensity, most of what it sees has
    the least one; so have all beams where there is no reflector.
    """

    def __init__(self) -> None:
        self._marks: set[str] = set()  # frames of such lasers

    def fault(self, scan: Scan) -> str:
        """Why those of a scan show nothing; empty if they do."""
        if not len(scan.intensities) or len(scan.intensities) != len(scan.ranges):
            return 'scans have no intensities'
        ranges, bright = valid_beams(scan)
        seen = bright[ranges > 0.0]
        if not len(seen):
            return 'no beam has a valid range and intensity'
        least, most = seen.min(), seen.max()
        if least == most:
            if scan.frame_id in self._marks:
                return ''
            return f'all beams of a scan have the intensity {least:g}'
        marks = len(seen) >= FEWEST and np.mean(seen == least) >= MOST
        if marks and len(self._marks) < MAX_LASERS:
            self._marks.add(scan.frame_id)
        elif not marks and len(seen) >= FEWEST:
            self._marks.discard(scan.frame_id)
        return ''


def detect(scan: Scan, params: Detector, floor: Callable[[Array], Array] | None = None) -> Found:
    """The reflectors of a scan; none where it has no intensities.

    ``floor`` has the least threshold by range, where the scans before have shown it.
    """
    n = len(scan.ranges)
    if len(scan.intensities) != n or n == 0 or scan.angle_increment == 0.0:
        return _found(scan, np.zeros((0, COLUMNS)), params)
    ranges, bright, bound = levels(scan, params, floor)
    settings = settings_of(params)
    beams = Beams(
        ranges, bright, settings.extent * bound,
        float(scan.angle_min), float(scan.angle_increment), is_circular(scan),
    )  # fmt: skip
    return _found(scan, find(beams, bound, settings), params)


def threshold(scan: Scan, params: Detector) -> Array:
    """Intensity (n,) that a reflector's brightest beam exceeds; 0 where nothing returned."""
    return levels(scan, params)[2]


def _found(scan: Scan, rows: Array, p: Detector) -> Found:
    fates = rows[:, FATE].astype(np.int64)
    counts = np.bincount(fates, minlength=len(Fate))
    rejected = {fate: int(counts[fate]) for fate in Fate if fate and counts[fate]}
    rows = rows[fates == Fate.FOUND]
    beams, none = rows[:, BEAM] % max(len(scan.ranges), 1), np.zeros(0)
    odds = rows[:, ODDS] + rows[:, TILTED]
    found = Found(none, none, none, beams, rows[:, WIDTH], rows[:, PEAK], odds, rejected, rows)
    return found.with_odds(odds, p.diameter)


def warm_up() -> None:
    """Compile the kernels."""
    surface_depth(0.0, 0.1, 0.1)
    opened(np.ones(3), np.ones(3), 0.1, False, 0.1)
    ones = np.ones(3, np.float32)
    detect(Scan(1, '', 0.0, 0.1, 0.0, 0.1, 2.0, ones, ones), Detector())
