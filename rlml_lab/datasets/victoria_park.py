# SPDX-License-Identifier: Apache-2.0
"""Victoria Park (Nebot and Guivant, ACFR): a ute among trees; dead reckoning, GPS, trunks.

``base_link`` is the centre of the rear axle. The vehicle (info.txt of the data set): wheel base
L = 2.83 m, half of the rear track H = 0.76 m, the encoder sits in the left rear wheel, and the
laser L + 0.95 m ahead of the rear axle and 0.5 m to its left.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from rlml_lab.datasets.mrclam import chain, from_polar
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections, Odometry

WHEEL_BASE, HALF_TRACK = 2.83, 0.76
T_BASE_LASER = np.array([WHEEL_BASE + 0.95, 0.5, 0.0])
LASER_FRAME = 'laser'
# A trunk is neither round nor upright, and at 3 m/s the scan's stamp is good to about 0.1 s.
SIGMA_RANGE, SIGMA_BEARING = 0.3, 0.02


@dataclass(frozen=True)
class VictoriaPark:
    """The whole drive. ``gps`` has positions only (headings NaN), in a frame of its own.

    ``counts``: ``trees`` seen, ``scans``, ``invalid`` detections that were left out.
    """

    odometry: list[Odometry]
    detections: list[Detections]
    gps: Trajectory
    counts: Counter[str] = field(default_factory=Counter)


def read_victoria_park(folder: str | Path) -> VictoriaPark:
    """Read the .mat files of the data set; FileFormatError names what is missing or wrong."""
    folder = Path(folder)
    drive = _load(folder / 'aa3_dr.mat', ('time', 'speed', 'steering'))
    gps = _load(folder / 'aa3_gpsx.mat', ('timeGps', 'Lo_m', 'La_m'))
    trees = _load(folder / 'VictoriaParkSinSincronizar.mat', ('TLsr', 'zt'))
    counts: Counter[str] = Counter()
    return VictoriaPark(
        _odometry(_milliseconds(drive['time']), drive['speed'].ravel(), drive['steering'].ravel()),
        _detections(trees['TLsr'].ravel(), trees['zt'].ravel(), counts),
        _gps(_milliseconds(gps['timeGps']), gps['Lo_m'].ravel(), gps['La_m'].ravel()),
        counts,
    )


def _load(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        data: dict[str, Any] = scipy.io.loadmat(path)
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e.strerror or e}') from e
    except Exception as e:  # the reader lets many kinds through for a damaged file
        raise FileFormatError(f'{path}: not a MATLAB file: {e}') from e
    missing = [name for name in names if name not in data]
    if missing:
        raise FileFormatError(f'{path}: has no variable {", ".join(missing)}')
    return data


def _milliseconds(values: Any) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Stamps [ns] of integer milliseconds."""
    return np.asarray(values, dtype=np.int64).ravel() * 1_000_000


def _odometry(stamps: Any, speed: Array, steering: Array) -> list[Odometry]:
    """Poses of the rear axle: v = v_left / (1 - tan(alpha) H / L), omega = v tan(alpha) / L."""
    if not len(stamps) == len(speed) == len(steering):
        raise FileFormatError('aa3_dr.mat: time, speed and steering differ in length')
    tangent = np.tan(steering)
    v = speed / (1.0 - tangent * HALF_TRACK / WHEEL_BASE)
    omega = v * tangent / WHEEL_BASE
    dt = np.diff(stamps) * 1e-9
    steps = se2.exp(np.stack([v[:-1] * dt, np.zeros(len(dt)), omega[:-1] * dt], axis=-1))
    return [Odometry(int(t), pose) for t, pose in zip(stamps, chain(steps), strict=True)]


def _detections(times: Array, cells: Any, counts: Counter[str]) -> list[Detections]:
    """One message per laser scan: range, bearing (pi/2 is straight ahead), trunk diameter."""
    out = []
    for time, cell in zip(times, cells, strict=True):
        z = np.asarray(cell, dtype=np.float64).reshape(3, -1)
        valid = np.isfinite(z[:2]).all(axis=0) & (z[0] > 0.0)
        counts['scans'] += 1
        counts['invalid'] += int(np.sum(~valid))
        r, bearing, diameter = z[:, valid]
        counts['trees'] += len(r)
        n = len(r)
        points, cov = from_polar(
            r, bearing - 0.5 * np.pi, np.full(n, SIGMA_RANGE), np.full(n, SIGMA_BEARING)
        )
        out.append(
            Detections(
                round(float(time) * 1000) * 1_000_000, LASER_FRAME, points, cov,
                np.full(n, ANONYMOUS, dtype=np.int64),
                np.where(diameter > 0.0, diameter, np.nan),
            )
        )  # fmt: skip
    return out


def _gps(stamps: Any, x: Array, y: Array) -> Trajectory:
    known = np.isfinite(x) & np.isfinite(y)
    known[1:] &= np.diff(stamps) > 0
    poses = np.stack([x, y, np.full(len(x), np.nan)], axis=-1)
    return Trajectory(stamps[known], poses[known])
