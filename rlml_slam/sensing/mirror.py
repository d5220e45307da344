# SPDX-License-Identifier: Apache-2.0
"""What a scanner that hangs upside down measured, as one beside it that stands upright sees it.

Half a turn about the sensor's x axis takes the one into the other: y and every angle change sign,
and the order in time of the rays stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rlml_slam.types import Detections, Scan

FLIP = np.array([1.0, -1.0])


def mirrored_scan(scan: Scan) -> Scan:
    """The same sweep, which turns the other way round."""
    return replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)


def mirrored_detections(seen: Detections) -> Detections:
    """The same reflectors on the other side."""
    return replace(seen, points=seen.points * FLIP, cov=seen.cov * np.outer(FLIP, FLIP))
