# SPDX-License-Identifier: Apache-2.0
"""Ranges that stand for "no return" although the message calls them valid.

REP-117 asks for +Inf. Many drivers and logs have the longest range instead, or a code such as
8.183 m with a range_max of 80 m: an arc around the sensor that goes where the robot goes, and so
holds it in place along a corridor. No wall is an arc: over ARC, a flat one is 1 % farther at the
ends than in the middle, and what is farthest of all that a scan sees is not round either.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import brief
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

ARC = 0.3  # [rad] of neighbouring beams of one and the same range, farther than all others
FEWEST = 8  # beams of it, some may be equal by chance; and fewer than these are stray ones


class NoReturnRanges:
    """What stands for "no return" in the scans of each lidar, by its frame.

    An arc shows it; from then on single beams of that range are none either, until the lidar
    measures something farther away, with more beams than dust and crosstalk take.
    """

    def __init__(self) -> None:
        self._codes: dict[str, list[float]] = {}

    def left_out(self, scan: Scan) -> Scan:
        """The scan with NaN where there is no return, zero being none; itself if there is all."""
        r = scan.ranges
        codes = self._codes.setdefault(scan.frame_id, [])
        enough = max(FEWEST, math.ceil(ARC / max(abs(scan.angle_increment), 1e-9)))
        while True:
            arc, none, beyond = _arc(r, np.array(codes), scan.range_min, scan.range_max, enough)
            codes[:] = [code for code, n in zip(codes, beyond.tolist(), strict=True) if n < FEWEST]
            if arc < 0.0:
                break
            codes.append(arc)
        if not none:
            return scan
        return replace(scan, ranges=np.where(np.isin(r, [0.0, *codes]), np.float32(np.nan), r))


@brief
def _arc(
    ranges: NDArray[np.float32], codes: Array, least: float, most: float, enough: int
) -> tuple[float, int, NDArray[np.int64]]:
    """(Range that ``enough`` neighbours have and few beams exceed, or -1; left out; beyond).

    Left out are 0 and the codes, which are no ranges; ``beyond`` each are so many beams.
    """
    arc, run, none = np.float32(-1.0), 0, 0
    last = arc
    beyond = np.zeros(len(codes), np.int64)
    for r in ranges:
        is_code = r == 0.0
        for code in codes:
            is_code |= r == code
        none += is_code
        if is_code or not least <= r <= most:
            run = 0
            continue
        for k in range(len(codes)):
            beyond[k] += r > codes[k]
        run = run + 1 if run and r == last else 1
        last = r
        if run >= enough and r > arc:
            arc = r
    farther = 0
    if arc >= 0.0:
        for r in ranges:
            is_code = False
            for code in codes:
                is_code |= r == code
            farther += not is_code and arc < r <= most
    return float(arc) if farther < FEWEST else -1.0, none, beyond


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    _arc(np.zeros(1, dtype=np.float32), np.zeros(0), 0.0, 1.0, 8)
