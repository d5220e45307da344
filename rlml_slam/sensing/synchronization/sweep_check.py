# SPDX-License-Identifier: Apache-2.0
"""Whether a sweep fits in the time between two scans: some drivers state a wrong time per ray."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from rlml_slam.motion import SECOND
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.types import Scan

MAX_SWEEP = 1.0  # [s] of one scan; all later inputs would wait for the odometry at its end
WINDOW, ENOUGH = 21, 5  # stamps of a laser, and intervals before anything is said
# of the intervals, one that is longer than this share of them is the period: up to five scans of
# one frame may come in one period, of several layers
SHARE = 0.8
LASERS = 100  # that are remembered
LONGER = 1.1  # times the period, that a sweep may last: stamps jitter


class SweepCheck:
    """The newest stamps [ns] of scans, by frame and first angle: lasers share a frame."""

    def __init__(self, inputs: InputCounts) -> None:
        self._inputs = inputs
        self._stamps: dict[tuple[str, float], deque[int]] = {}

    def possible(self, scan: Scan) -> Scan:
        """The scan itself, or with a sweep that ends at the next scan, or without ray times."""
        period, lasts = self._period(scan), sweep_time(scan)
        if 0.0 <= lasts <= min(LONGER * period, MAX_SWEEP):
            return scan
        fits = period if lasts > 0.0 and period <= MAX_SWEEP else 0.0
        error = f'time_increment {scan.time_increment:g} s times {len(scan.ranges)} beams is no '
        error += f'sweep of 0 to {min(period, MAX_SWEEP):.3g} s'
        self._inputs.count('scan', 'sweep_time', error)
        return replace(scan, time_increment=fits / len(scan.ranges))

    def _period(self, scan: Scan) -> float:
        """Time [s] between two scans of a laser, infinite as long as it is not known."""
        laser = scan.frame_id, round(scan.angle_min, 1)
        stamps = self._stamps.setdefault(laser, deque(maxlen=WINDOW))
        if len(self._stamps) > LASERS:  # names in messages may be anything
            del self._stamps[next(iter(self._stamps))]
        stamps.append(scan.stamp)
        steps = np.sort(np.abs(np.diff(stamps)))
        return float(steps[int(SHARE * len(steps))]) / SECOND if len(steps) >= ENOUGH else math.inf
