# SPDX-License-Identifier: Apache-2.0
"""UTIAS MR.CLAM (Leung et al., IJRR 2011): robots with a camera among barcode landmarks.

    Robot<r>_Odometry.dat      time, forward velocity, angular velocity
    Robot<r>_Measurement.dat   time, barcode, range, bearing
    Robot<r>_Groundtruth.dat   time, x, y, heading
    Landmark_Groundtruth.dat   subject, x, y, std x, std y
    Barcodes.dat               subject, barcode

Files may be compressed (.gz, .xz). Measurements are in the robot's frame.

The camera measures a range by the size of a barcode in the image, which gives the depth along the
optical axis: a pinhole camera shows a barcode of height s at depth Z as f s/Z pixels, wherever in
the picture it is. The logged ranges are depths times one factor; against the truth of data set 6
they are right to 1 % for each robot once divided by the cosine of the bearing, and off by 10 %
from the middle of the picture to its rim without.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.datasets.text_file import SECOND, parse_numbers, parse_stamp, read_lines
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.types import ANONYMOUS, Detections, Odometry

FIRST_LANDMARK = 6  # subjects 1 to 5 are the robots
# Half of a picture 60 degrees wide. Whoever calibrated the ranges made them right in the mean over
# the picture, so they are depths times 1/mean(cos bearing) = 1.05 (data set 6: 1.03 to 1.05).
HALF_VIEW = np.pi / 6
MEAN_COS = np.sin(HALF_VIEW) / HALF_VIEW
RIM = 0.5  # least cosine of a bearing: nothing is seen so far from the axis
# The size of a barcode is measured in pixels, so the error of the range grows with it; that of the
# bearing, which comes from one pixel, does not.
RANGE_NOISE, RANGE_NOISE_FLOOR = 0.045, 0.04  # per range, [m]
DEPTH_NOISE = 0.02  # the same of ranges from depths; most of it are the robots' different factors
BEARING_NOISE = 0.01  # [rad]


@dataclass(frozen=True)
class MrclamRobot:
    """One robot's run.

    ``truth`` is None where the data set has none; ``landmark_ids`` (m,) are subject numbers,
    ``landmark_points`` (m, 2) [m] in the frame of the truth.
    ``counts``: measurements ``used``, ``of_robots``, ``misread``, ``invalid``.
    """

    odometry: list[Odometry]
    detections: list[Detections]
    truth: Trajectory | None
    landmark_ids: NDArray[np.int64]
    landmark_points: Array
    counts: Counter[str] = field(default_factory=Counter)


def read_mrclam(
    folder: str | Path, robot: int, ids: bool = True, depths: bool = False
) -> MrclamRobot:
    """Read one robot's run; without ``ids`` the detections are anonymous.

    ``depths``: what is logged is taken for the depths that it is, and made ranges.

    Raises FileFormatError for missing files and malformed lines (file:line).
    """
    folder = Path(folder)
    subject_of = {
        int(barcode): int(subject)
        for _, (subject, barcode) in _rows(_find(folder, 'Barcodes.dat'), 2, first_is_time=False)
    }
    landmarks = [
        v for _, v in _rows(_find(folder, 'Landmark_Groundtruth.dat'), 5, first_is_time=False)
    ]
    counts: Counter[str] = Counter()
    return MrclamRobot(
        _odometry(_find(folder, f'Robot{robot}_Odometry.dat')),
        _detections(
            _find(folder, f'Robot{robot}_Measurement.dat'), subject_of, ids, depths, counts
        ),
        _truth(folder, f'Robot{robot}_Groundtruth.dat'),
        np.array([row[0] for row in landmarks], dtype=np.int64),
        np.array([row[1:3] for row in landmarks], dtype=np.float64).reshape(-1, 2),
        counts,
    )


def _find(folder: Path, name: str) -> Path:
    for suffix in ('', '.xz', '.gz'):
        if (folder / f'{name}{suffix}').is_file():
            return folder / f'{name}{suffix}'
    raise FileFormatError(f'{folder}: has no {name}, which an MR.CLAM data set needs')


def _rows(path: Path, width: int, first_is_time: bool = True) -> list[tuple[int, Array]]:
    """(stamp [ns] or 0, values) of each line; the stamp is none of the values."""
    rows = []
    for number, line in read_lines(path):
        words = line.split()
        try:
            if len(words) != width:
                raise ValueError(f'{len(words)} values, {width} expected')
            stamp = parse_stamp(words[0]) if first_is_time else 0
            rows.append((stamp, parse_numbers(words[1:] if first_is_time else words)))
        except ValueError as e:
            raise FileFormatError(f'{path}:{number}: {e}') from e
    if not rows:
        raise FileFormatError(f'{path}: no data in it')
    return rows


def _odometry(path: Path) -> list[Odometry]:
    """Poses from velocities: each holds from its stamp to the next one (constant twist)."""
    rows = sorted(_rows(path, 3), key=lambda row: row[0])
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    u = np.array([values for _, values in rows])
    dt = np.diff(stamps) / SECOND
    steps = se2.exp(np.stack([u[:-1, 0] * dt, np.zeros(len(dt)), u[:-1, 1] * dt], axis=-1))
    poses = chain(steps)
    # several rows may bear one stamp; the pose at it is the same
    first = np.concatenate([[True], np.diff(stamps) > 0])
    return [Odometry(int(t), pose) for t, pose in zip(stamps[first], poses[first], strict=True)]


def chain(steps: Array) -> Array:
    """Poses (n + 1, 3) reached from the origin by n relative poses ``steps`` (n, 3)."""
    theta = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moved = np.einsum('nij,nj->ni', se2.rotation(theta[:-1]), steps[:, :2])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.concatenate([xy, se2.wrap(theta)[:, None]], axis=1)


def _detections(
    path: Path, subject_of: dict[int, int], ids: bool, depths: bool, counts: Counter[str]
) -> list[Detections]:
    """Rows of one stamp become one message; what is no landmark is left out and counted."""
    seen: dict[int, list[tuple[int, float, float]]] = {}
    for stamp, (barcode, r, bearing) in _rows(path, 4):
        subject = subject_of.get(int(barcode))
        if subject is None:
            counts['misread'] += 1
        elif subject < FIRST_LANDMARK:
            counts['of_robots'] += 1
        elif r <= 0.0:
            counts['invalid'] += 1
        else:
            counts['used'] += 1
            seen.setdefault(stamp, []).append((subject, float(r), float(bearing)))
    return [_message(stamp, rows, ids, depths) for stamp, rows in sorted(seen.items())]


def _message(
    stamp: int, rows: list[tuple[int, float, float]], ids: bool, depths: bool
) -> Detections:
    subjects = np.array([row[0] for row in rows], dtype=np.int64)
    r, bearing = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    if depths:
        r = MEAN_COS * r / np.maximum(np.cos(bearing), RIM)
    sigma_r = np.hypot((DEPTH_NOISE if depths else RANGE_NOISE) * r, RANGE_NOISE_FLOOR)
    points, cov = from_polar(r, bearing, sigma_r, np.full(len(r), BEARING_NOISE))
    return Detections(
        stamp,
        'base_link',
        points,
        cov,
        subjects if ids else np.full(len(rows), ANONYMOUS, dtype=np.int64),
        np.full(len(rows), np.nan),
    )


def from_polar(r: Array, bearing: Array, sigma_r: Array, sigma_b: Array) -> tuple[Array, Array]:
    """Points (n, 2) and covariances (n, 2, 2) of range and bearing measurements (n,)."""
    u = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    return r[:, None] * u, polar_covariance(u, sigma_r**2, (r * sigma_b) ** 2)


def _truth(folder: Path, name: str) -> Trajectory | None:
    try:
        path = _find(folder, name)
    except FileFormatError:
        return None
    rows = sorted(_rows(path, 4), key=lambda row: row[0])
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    poses = np.array([values for _, values in rows])
    poses[:, 2] = se2.wrap(poses[:, 2])
    first = np.concatenate([[True], np.diff(stamps) > 0])
    return Trajectory(stamps[first], poses[first])
