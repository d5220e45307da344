# SPDX-License-Identifier: Apache-2.0
"""The LEGO robot among cylinders (C. Brenner's SLAM lectures): scans, wheel ticks, camera track.

    robot4_scan.txt             S time_ms count range_mm ...  (counter-clockwise)
    robot4_motors.txt           M time_ms left_ticks ... right_ticks ...  (columns 3 and 7)
    robot4_reference.txt        P time_ms x_mm y_mm  (of the scanner, in the arena)
    robot_arena_landmarks.txt   L C x_mm y_mm diameter_mm

``base_link`` is the middle between the wheels. Each stream has stamps of its own: motors are asked
less often than scans come, so that every fifth of their rows is the one before once more, and the
scanner's data is the oldest by the time it is stamped. Here all stamps are the scanner's, those of
the first beams of its sweeps; :mod:`rlml_lab.lego.lego_time` estimates what lies between.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_lab.datasets.mrclam import chain
from rlml_slam.datasets.text_file import parse_numbers, read_lines
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array
from rlml_slam.types import Odometry, Scan

MM = 1e-3
METRES_PER_TICK = 0.349e-3
WHEEL_BASE = 0.173  # [m] between the tracks; of 0.150 to 0.173 in use
BEAM, MOUNTING, MIDDLE = 0.006135923151543, 0.06981317007977318, 330
T_BASE_LASER = np.array([0.03, 0.0, -MOUNTING])
START = (1.850, 1.897, math.radians(213.0))  # of the scanner
LASER_FRAME = 'laser'
RANGE_MIN, RANGE_MAX = 0.02, 5.0
BEAM_TIME = 0.1 / 1024  # [s] of an URG-04LX: 600 revolutions per minute
# [s] by which the middle of a sweep is older than its stamp says, by the wheels' clock, and the
# camera's pictures: by turn rates of scans and wheels and by speeds of camera and wheels alone
SCAN_LAG, CAMERA_LAG = 0.46, 0.20


@dataclass(frozen=True)
class Lego:
    """``track`` (headings NaN) is the scanner's, in the arena, as ``landmarks`` (m, 2) [m]."""

    odometry: list[Odometry]
    scans: list[Scan]
    track: Trajectory
    landmarks: Array
    counts: Counter[str] = field(default_factory=Counter)


def read_lego(folder: str | Path) -> Lego:
    """Read the four files; FileFormatError names what is missing or malformed."""
    folder = Path(folder)
    scans = [_scan(stamp, v) for stamp, v in _rows(folder / 'robot4_scan.txt', 'S')]
    motors = _rows(folder / 'robot4_motors.txt', 'M')
    track = _rows(folder / 'robot4_reference.txt', 'P')
    cylinders = [
        parse_numbers(line.split()[2:])
        for _, line in read_lines(folder / 'robot_arena_landmarks.txt')
        if line.startswith('L C')
    ]
    ticks = np.array([v[[0, 4]] for _, v in motors], dtype=np.float64)
    at, first = _times(motors, 0.0)
    # the first scans are from before the wheels were asked
    scans = [scan for scan in scans if scan.stamp >= at[0]]
    seen, row = _times(track, CAMERA_LAG)
    poses = np.array([[v[0] * MM, v[1] * MM, np.nan] for _, v in track])
    counts = Counter(scans=len(scans), cylinders=len(cylinders))
    return Lego(
        _odometry(at, ticks[first] * METRES_PER_TICK),
        scans,
        Trajectory(seen, poses[row]),
        np.array(cylinders)[:, :2] * MM,
        counts,
    )


def _times(
    rows: list[tuple[int, Array]], lag: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stamps of the first beams' clock and the rows that have them, each once.

    ``lag`` [s] is what the rows are older than their stamps by the wheels' clock.
    """
    stamps, first = np.unique([stamp for stamp, _ in rows], return_index=True)
    # a sweep's stamp is its first beam's, half a sweep before its middle
    later = round((SCAN_LAG - lag + MIDDLE * BEAM_TIME) * 1e9)
    return stamps + later, first


def _rows(path: Path, kind: str) -> list[tuple[int, Array]]:
    """(stamp [ns], values) of the lines that begin with ``kind``."""
    rows = []
    for number, line in read_lines(path):
        words = line.split()
        if words[0] != kind:
            continue
        try:
            rows.append((int(words[1]) * 1_000_000, parse_numbers(words[2:])))
        except (ValueError, IndexError) as e:
            raise FileFormatError(f'{path}:{number}: {e}') from e
    if not rows:
        raise FileFormatError(f'{path}: no {kind} lines in it')
    return rows


def _scan(stamp: int, values: Array) -> Scan:
    ranges = values[1:] * MM
    none = np.zeros(0, dtype=np.float32)
    return Scan(
        stamp, LASER_FRAME, -MIDDLE * BEAM, BEAM, BEAM_TIME, RANGE_MIN, RANGE_MAX,
        np.where(ranges > RANGE_MIN, ranges, np.nan).astype(np.float32), none,
    )  # fmt: skip


def _odometry(stamps: NDArray[np.int64], wheels: Array) -> list[Odometry]:
    """Poses of the middle between the wheels, from the ways (n, 2) of the left and right one."""
    step = np.diff(wheels, axis=0)
    turn = (step[:, 1] - step[:, 0]) / WHEEL_BASE
    way = step.mean(axis=1)
    # the chord of the arc
    chord = way * np.sinc(0.5 * turn / np.pi)
    steps = np.stack([chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn), turn], -1)
    return [Odometry(int(t), pose) for t, pose in zip(stamps, chain(steps), strict=True)]
