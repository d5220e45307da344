# SPDX-License-Identifier: Apache-2.0
"""Spike landmarks: what stands out towards the laser from what is beside it.

Beams without a return are skipped, never read as far points: neighbours are neighbours among the
valid beams.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Spikes
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.types import Scan


@dataclass(frozen=True)
class Extracted:
    """``points`` (k, 2) and ``cov`` (k, 2, 2) in the frame of the scan; ``beams`` (k,) mean index.

    Each point is where it was seen from at the time of its own beam.
    """

    points: Array
    cov: Array
    beams: Array


def extract(scan: Scan, params: Spikes) -> Extracted:
    """The spikes of a scan by the test that ``params`` name."""
    beams, ranges = valid_beams(scan)
    circular = abs(scan.angle_increment) * len(scan.ranges) >= 2.0 * math.pi - 1e-3
    if params.test == 'jump':
        spans = jump_spans(ranges, params.threshold, circular)
    else:
        spans = sum_spans(ranges, params.threshold, params.neighbour_offset, circular)
    rows = []
    for first, last in spans:
        k = np.arange(first, last + 1)
        turns, k = k // len(ranges), k % len(ranges)
        row = _spike(scan, params, beams[k] + turns * len(scan.ranges), ranges[k])
        if row is not None:
            rows.append(row)
    return _extracted(scan, params, np.array(rows).reshape(-1, 2))


def valid_beams(scan: Scan) -> tuple[NDArray[np.int64], Array]:
    """Indices (m,) and ranges (m,) of the beams with a return."""
    r = np.asarray(scan.ranges, dtype=np.float64)
    with np.errstate(invalid='ignore'):
        beams = np.flatnonzero((r >= scan.range_min) & (r <= scan.range_max))
    return beams, r[beams]


def jump_spans(ranges: Array, threshold: float, circular: bool) -> list[tuple[int, int]]:
    """Spans (first, last) that lie nearer than both neighbours by more than the threshold.

    The note's first test, "two values differ by more than the threshold", applied on both sides:
    one jump alone is also the edge of a wall. Indices of a circular scan may pass its end.
    """
    n = len(ranges)
    if n < 3:
        return []
    after = np.append(ranges[1:], ranges[0] if circular else np.nan)
    step = after - ranges
    falls, rises = np.flatnonzero(step < -threshold), np.flatnonzero(step > threshold)
    if circular and len(rises):
        rises = np.append(rises, rises[0] + n)
    spans = []
    for k, fall in enumerate(falls):
        j = np.searchsorted(rises, fall + 1)
        if j == len(rises):
            continue
        # another fall before the next rise: this one was the edge of something behind
        following = falls[k + 1] if k + 1 < len(falls) else (falls[0] + n if circular else 2 * n)
        if following >= rises[j]:
            spans.append((int(fall) + 1, int(rises[j])))
    return spans


def sum_spans(
    ranges: Array, threshold: float, reach: int, circular: bool
) -> list[tuple[int, int]]:
    """Spans of neighbouring beams B with (A - B) + (C - B) over the threshold (second test).

    A and C lie ``reach`` beams to the sides. Both have to lie behind B, by a quarter of the
    threshold: the sum alone is also passed by the edge of any wall before a far background.
    """
    n = len(ranges)
    if n < 2 * reach + 1:
        return []
    a, c = np.roll(ranges, reach) - ranges, np.roll(ranges, -reach) - ranges
    is_spike = (a + c > threshold) & (np.minimum(a, c) > 0.25 * threshold)
    if not circular:
        is_spike[:reach] = is_spike[n - reach :] = False
    if is_spike.all():
        return []
    start = int(np.flatnonzero(~is_spike)[0]) if circular else 0
    turned = np.concatenate([[False], np.roll(is_spike, -start), [False]])
    edges = np.flatnonzero(np.diff(turned.astype(np.int8)))
    return [(int(f) + start, int(e) - 1 + start) for f, e in edges.reshape(-1, 2)]


def _spike(
    scan: Scan, params: Spikes, beams: NDArray[np.int64], ranges: Array
) -> tuple[float, float] | None:
    """Mean range and mean beam of a span, None if it is too wide, too far or too few beams."""
    r = float(ranges.mean())
    step, steps = abs(scan.angle_increment), float(beams[-1] - beams[0])
    if (
        len(beams) < params.min_beams
        or r > params.max_range
        or step * steps * r > params.max_width
    ):
        return None
    # A cylinder at r + depth is as wide as the beams that hit it, in the mean of many; averaged
    # over its width, its surface lies pi/8 of the diameter before its centre.
    share = math.pi / 8.0 * step * (steps + 1.0) if params.cylindrical else 0.0
    return r / (1.0 - min(share, 0.5)) + params.range_offset, float(beams.mean())


def _extracted(scan: Scan, params: Spikes, rows: Array) -> Extracted:
    angle = scan.angle_min + rows[:, 1] * scan.angle_increment
    u = np.stack([np.cos(angle), np.sin(angle)], -1)
    cov = polar_covariance(u, params.sigma_range**2, (rows[:, 0] * params.sigma_bearing) ** 2)
    return Extracted(rows[:, :1] * u, cov, rows[:, 1] % max(len(scan.ranges), 1))
