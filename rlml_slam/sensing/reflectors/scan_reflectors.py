# SPDX-License-Identifier: Apache-2.0
"""Reflectors in the intensities of the scans themselves, where no topic brings them."""

from __future__ import annotations

import math

from rlml_slam import se2
from rlml_slam.params import Detector
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.reflector_calibration import Calibration, ReflectorCalibration
from rlml_slam.sensing.reflectors.reflector_detector import MAX_LASERS, IntensityCheck, detect
from rlml_slam.sensing.reflectors.reflector_shapes import SHARED, ReflectorShapes
from rlml_slam.types import Detections, Scan


class ScanReflectors:
    """Detects the reflectors of scans; ``mode`` is the parameter detect_reflectors.

    With auto, brightness and size of reflectors are those that the scans show, and there are no
    detections as long as nothing stands out. With on they are those of the parameters.
    """

    def __init__(self, params: Detector, mode: str) -> None:
        self._p = params
        self._mode = mode
        self._lasers: dict[str, ReflectorCalibration] = {}
        self._shapes = ReflectorShapes()
        self._intensities = IntensityCheck()
        self.num_scans = self.num_found = 0

    def detections(
        self,
        scan: Scan,
        T_base_laser: Array,
        sweep: Array,
        sweep_cov: Array | None = None,
        T_odom_base: Array | None = None,
    ) -> Detections | None:
        """The reflectors of a scan at its stamp, in the frame of the laser; None if not looked.

        ``sweep`` (a, 3) is the motion of base during the sweep, by arcs, with the covariance of
        all of it. With the pose of base in odom (3,), the scans before help to say what the shape
        of a reflector is.
        """
        if self._mode == 'off' or len(scan.intensities) != len(scan.ranges):
            return None
        detector, calibration, sigma_size = self._p, None, 0.0
        T_odom_laser = None if T_odom_base is None else se2.compose(T_odom_base, T_base_laser)
        if self._mode == 'auto':
            calibration = self._calibrated(scan, T_odom_laser)
            if calibration is None:
                return None
            detector, sigma_size = calibration.detector, calibration.sigma_size
        # to a laser with a few levels of intensity, all that is diffuse has 0
        has_levels = calibration is not None and math.isinf(calibration.ratio)
        if self._intensities.fault(scan) and not has_levels:
            return None
        found = detect(scan, detector, None if calibration is None else calibration.floor)
        odds, shared = found.odds, 1.0
        if T_odom_laser is not None:
            points = found.at_stamp(scan, T_base_laser, sweep, once=False).points
            points = se2.transform(T_odom_laser, points)
            odds = self._shapes.update(scan.stamp, points, T_odom_laser[:2], found.rows)
            shared = SHARED
        found = found.with_odds(odds, detector.diameter, shared, sigma_size)
        self.num_scans += 1
        self.num_found += len(found)
        return found.at_stamp(scan, T_base_laser, sweep, sweep_cov)

    def _calibrated(self, scan: Scan, T_odom_laser: Array | None) -> Calibration | None:
        laser = self._lasers.get(scan.frame_id)
        if laser is None:
            if len(self._lasers) >= MAX_LASERS or scan.angle_increment == 0.0:
                return None
            laser = self._lasers[scan.frame_id] = ReflectorCalibration(self._p)
        laser.add(scan, T_odom_laser)
        return laser.result

    def __str__(self) -> str:
        """What was found, and by which threshold, in words; empty if nothing was looked at."""
        if self.num_scans:
            mean = self.num_found / self.num_scans
            found = [c.result for c in self._lasers.values() if c.result is not None]
            return f'{mean:.1f} in a scan{"".join(f"; {in_words(c)}" for c in found)}'
        return 'nothing stands out of what is diffuse' if self._lasers else ''


def in_words(c: Calibration) -> str:
    """By which threshold reflectors are found."""
    p = c.detector
    size = f'{1e3 * max(p.diameter, p.flat_width):.0f} mm wide'
    if math.isinf(c.ratio):
        return f'bright where nothing else has an intensity; {size}'
    return (
        f'at least {p.contrast:.1f} times as bright as anything diffuse at their range, most of '
        f'them {c.ratio:.1f} times; {size}'
    )
