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
        none = r == 0.0
        for code in codes:
            none |= r == code
        valid = (r >= scan.range_min) & (r <= scan.range_max) & ~none
        while valid.any():
            longest = float(r[valid].max())
            equal = r == longest
            beams = longest_run(equal)
            if beams < FEWEST or beams * abs(scan.angle_increment) < ARC:
                codes[:] = [code for code in codes if code > longest]
                break
            codes.append(longest)
            none |= equal
            valid &= ~equal
        if not none.any():
            return scan
        return replace(scan, ranges=np.where(none, np.float32(np.nan), r))


def longest_run(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of neighbours that are all true."""
    ends = np.flatnonzero(np.diff(np.concatenate(([0], flags.view(np.int8), [0]))))
    return int((ends[1::2] - ends[::2]).max(initial=0))
