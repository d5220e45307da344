# SPDX-License-Identifier: Apache-2.0
"""Recorded runs among reflectors whose places are known: R2000, LEGO robot, MR.CLAM.

Each becomes looks: what one scan, or one picture, saw from where. The noise of each sensor is what
its data sheet would say, or its detector states. Of the LEGO robot, the offset of the ranges and
the scale of the true track are fitted to the true map.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_lab.datasets.lego import BEAM, MIDDLE, T_BASE_LASER, read_lego
from rlml_lab.datasets.mrclam import HALF_VIEW, from_polar, read_mrclam
from rlml_lab.lego.lego_scale import fit_scale
from rlml_lab.lego.study_lego import PARAMETERS, associate, cylinder_ranges, drive, track_places
from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.evaluation.ate import interpolate
from rlml_slam.params import Detector, Reflector
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.reflector_detector import detect
from rlml_slam.types import Detections

R2000_DIAMETER = 0.06  # [m] by circles through the ranges of all scans
R2000_NEAR = 0.15  # [m] from a reflector of the layout, a detection is of it
CAMERA_RANGE = 6.0  # [m] 95 % of MR.CLAM's measurements are nearer
ROBOTS = (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Look:
    """The true ``pose`` (3,) of the sensor, in the layout, and ``seen``: ids are rows of it."""

    pose: Array
    seen: Detections


@dataclass(frozen=True)
class RealRun:
    """A layout (m, 2) of cylinders [m], the sensor's noise and ``field`` of view [rad], looks."""

    name: str
    points: Array
    width: float
    sensor: Reflector
    field: float
    looks: Sequence[Look]


def read_all(folder: Path) -> list[RealRun]:
    """The three of them; FileFormatError if one is malformed or not there."""
    return [
        r2000(folder / 'reflector-r2000'), lego(folder / 'lego-cylinders'),
        mrclam(folder / 'mrclam' / 'dataset6'),
    ]  # fmt: skip


def r2000(folder: Path) -> RealRun:
    """A laser at rest in the origin of the author's own list, which has the reflectors' faces."""
    path = folder / 'author_detections_pos0.txt'
    try:
        text = path.read_text(encoding='utf-8')
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e}') from e
    faces = np.array(re.findall(r'position is ([-\d.]+), ([-\d.]+)', text), dtype=np.float64)
    if not len(faces):
        raise FileFormatError(f'{path}: no "position is x, y" in it')
    points = faces * (1.0 + 0.5 * R2000_DIAMETER / np.hypot(*faces.T))[:, None]
    sensor, looks = Reflector(), []
    with BagReader(folder / 'r2000_locate0.bag') as bag:
        scans = [decode.scan(m) for _, _, m in bag.messages(['/scan'])]
    for scan in scans:
        z = detect(scan, Detector(diameter=R2000_DIAMETER)).points
        gap = np.hypot(*(z[:, None] - points).transpose(2, 0, 1))
        near = gap.min(axis=1) < R2000_NEAR
        row = gap.argmin(axis=1)[near]
        looks.append(Look(np.zeros(3), _detections(scan.stamp, z[near], row, sensor)))
    return RealRun('R2000 at rest', points, R2000_DIAMETER, sensor, 2.0 * np.pi, looks)


def lego(folder: Path) -> RealRun:
    """The LEGO robot: places by the camera in its true size, headings by the EKF."""
    data = read_lego(folder)
    result = drive(data)
    ranges = cylinder_ranges(data, result)
    size = fit_scale(data.track, data.landmarks, ranges)
    nearest = associate(data, result)
    found = nearest >= 0
    T = se2.align(result.reflectors.points[found], data.landmarks[nearest[found]])
    poses = se2.compose(se2.compose(T, result.scanner), np.array([0.0, 0.0, T_BASE_LASER[2]]))
    track = size.scale * track_places(data)
    poses[:, :2] = se2.transform(se2.align(track, poses[:, :2]), track)
    reach = float(PARAMETERS['spikes.max_range'])
    sensor = replace(
        Reflector(), sigma_range=PARAMETERS['spikes.sigma_range'],
        sigma_bearing=PARAMETERS['spikes.sigma_bearing'], max_range=reach,
    )  # fmt: skip
    looks = []
    for k, pose in enumerate(poses):
        mine = ranges.scans == k
        r, bearing = ranges.measured[mine] + size.offset, ranges.bearings[mine]
        z = r[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        stamp = data.scans[k].stamp
        looks.append(Look(pose, _detections(stamp, z, ranges.cylinders[mine], sensor)))
    return RealRun('LEGO robot', data.landmarks, 0.11, sensor, 2.0 * MIDDLE * BEAM, looks)


def mrclam(folder: Path) -> RealRun:
    """Five robots with cameras; the noise is the mean of what the detections state."""
    looks, noise = [], []
    for robot in ROBOTS:
        data = read_mrclam(folder, robot, depths=True)
        if data.truth is None:
            raise FileFormatError(f'{folder}: no ground truth of robot {robot}')
        poses, known = interpolate(data.truth, np.array([d.stamp for d in data.detections]))
        row = {int(i): k for k, i in enumerate(data.landmark_ids)}
        for d, pose, is_known in zip(data.detections, poses, known, strict=True):
            if is_known:
                ids = np.array([row[int(i)] for i in d.ids], dtype=np.int64)
                looks.append(Look(pose, replace(d, ids=ids)))
                u = d.points / np.hypot(*d.points.T)[:, None]
                noise.extend(np.einsum('ki,kij,kj->k', u, d.cov, u))
    sensor = replace(Reflector(), sigma_range=float(np.sqrt(np.mean(noise))), sigma_bearing=0.01,
                     max_range=CAMERA_RANGE)  # fmt: skip
    return RealRun('MR.CLAM 6', data.landmark_points, 0.1, sensor, 2.0 * HALF_VIEW, looks)


def _detections(stamp: int, z: Array, row: NDArray[np.int64], sensor: Reflector) -> Detections:
    r, bearing = np.hypot(*z.T), np.arctan2(z[:, 1], z[:, 0])
    n = len(z)
    points, cov = from_polar(
        r, bearing, np.full(n, sensor.sigma_range), np.full(n, sensor.sigma_bearing)
    )
    return Detections(stamp, 'laser', points, cov, row, np.full(n, np.nan))
