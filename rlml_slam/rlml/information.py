# SPDX-License-Identifier: Apache-2.0
"""How much a scan match is worth."""

from __future__ import annotations

import numpy as np

from rlml_slam.se2 import Array


def calibrated(information: Array, floor2: tuple[float, ...]) -> Array:
    """Information (3, 3) of a scan match whose covariance is never below the floor.

    ``information`` is H / sigma_s^2 of the scan term, ``floor2`` (3,) the variances of the part of
    the error that more beams do not average out (the grid, neighbours on one surface). It is
    (information^-1 + floor)^-1, written so that a direction that the scan does not hold stays at
    zero.
    """
    floor = np.zeros((3, 3))
    floor[[0, 1, 2], [0, 1, 2]] = floor2
    out = np.linalg.solve(np.eye(3) + information @ floor, information)
    return 0.5 * (out + out.T)
