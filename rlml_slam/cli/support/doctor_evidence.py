# SPDX-License-Identifier: Apache-2.0
"""What the scans of a bag hold, as ``rlml doctor`` examines and draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array
from rlml_slam.types import Scan

KEPT = 200_000  # beams in the picture at most


@dataclass(frozen=True)
class Evidence:
    """What the scans hold: beams (n, 2) of range and intensity, spots (m, 2) of reflectors.

    ``is_spot`` (n,) marks beams on reflectors, ``levels`` (n,) are the intensities of other
    surfaces at the ranges of the beams, ``counts`` (s,) reflectors per scan, ``widths`` (m,) [m]
    of spots as seen; ``found_by`` says by which threshold, where it was learned.
    """

    scan: Scan
    counts: Array
    beams: Array
    is_spot: NDArray[np.bool_]
    levels: Array
    spots: Array
    widths: Array
    found_by: str = ''
