# SPDX-License-Identifier: Apache-2.0
"""Ranges that stand for "no return" although the message calls them valid.

REP-117 asks for +Inf. Many drivers and logs have the longest range instead, or a code such as
8.183 m with a range_max of 80 m: an arc around the sensor that goes where the robot goes, and so
holds it in place along a corridor. No wall is an arc: over ARC, a flat one is 1 % farther at the
ends than in the middle, and what is farthest of all that a scan sees is not round either.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import brief
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

ARC = 0.3  # [rad] of neighbouring beams of one and the same range, the longest of the scan
FEWEST = 8  # beams of it: some may be equal by chance


class NoReturns:
    """What stands for "no return" in the scans of each lidar, by its frame.

    An arc shows it; from then on single beams of that range are none either, until the lidar
    measures something farther away.
    """

    def __init__(self) -> None:
        self._codes: dict[str, list[float]] = {}

    def left_out(self, scan: Scan) -> Scan:
        """The scan with NaN where there is no return, zero being none; itself if there is all."""
        r = scan.ranges
        codes = self._codes.setdefault(scan.frame_id, [])
        while True:
            longest, beams, none = _farthest(r, np.array(codes), scan.range_min, scan.range_max)
            if beams < FEWEST or beams * abs(scan.angle_increment) < ARC:
                break
            codes.append(longest)
        codes[:] = [code for code in codes if code > longest]
        if not none:
            return scan
        return replace(scan, ranges=np.where(np.isin(r, [0.0, *codes]), np.float32(np.nan), r))


@brief
def _farthest(
    ranges: NDArray[np.float32], codes: Array, least: float, most: float
) -> tuple[float, int, int]:
    """(Longest range in [least, most], longest run of neighbours that have it, beams left out).

    Left out are 0 and the codes, which are no ranges.
    """
    longest, beams, run, none = -np.inf, 0, 0, 0
    for r in ranges:
        told = r == 0.0
        for code in codes:
            told |= r == code
        none += told
        if told or not least <= r <= most:
            run = 0
            continue
        if r > longest:
            longest, beams, run = r, 0, 0
        run = run + 1 if r == longest else 0
        beams = max(beams, run)
    return float(longest), beams, none


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    _farthest(np.zeros(1, dtype=np.float32), np.zeros(0), 0.0, 1.0)
