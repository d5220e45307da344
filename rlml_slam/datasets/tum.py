# SPDX-License-Identifier: Apache-2.0
"""Trajectories as TUM text: ``stamp x y z qx qy qz qw`` per pose, seconds with nanoseconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam.datasets.text_file import format_stamp, parse_numbers, parse_stamp, read_lines
from rlml_slam.errors import FileFormatError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.se2 import Array, wrap


@dataclass(frozen=True)
class Trajectory:
    """``stamps`` (n,) int64 [ns], strictly increasing, and ``poses`` (n, 3).

    The headings are NaN throughout where only positions are known.
    """

    stamps: NDArray[np.int64]
    poses: Array

    def __len__(self) -> int:
        return len(self.stamps)


def read_tum(path: str | Path) -> Trajectory:
    """The planar trajectory of a TUM file (also .gz, .xz): x, y and the yaw of each pose.

    Raises FileFormatError, with the line, for a malformed line and for stamps that do not rise.
    """
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in read_lines(path):
        try:
            stamp, pose = _parse(line)
        except ValueError as e:
            raise FileFormatError(f'{path}:{number}: {e}') from e
        if stamps and stamp <= stamps[-1]:
            raise FileFormatError(f'{path}:{number}: stamp {line.split()[0]} does not rise')
        stamps.append(stamp)
        poses.append(pose)
    if not stamps:
        raise FileFormatError(f'{path}: no poses in it')
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))


def _parse(line: str) -> tuple[int, tuple[float, float, float]]:
    words = line.replace(',', ' ').split()
    if len(words) != 8:
        raise ValueError(f'{len(words)} values, 8 expected: stamp x y z qx qy qz qw')
    stamp = parse_stamp(words[0])
    x, y, _, qx, qy, qz, qw = parse_numbers(words[1:])
    if abs(math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw) - 1.0) > 0.01:
        raise ValueError('the quaternion is not of unit length')
    yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return stamp, (float(x), float(y), yaw)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory; the file appears whole or not at all. Equal poses give equal bytes."""
    half = 0.5 * wrap(trajectory.poses[:, 2])
    rows = zip(
        trajectory.stamps, trajectory.poses[:, 0], trajectory.poses[:, 1],
        np.sin(half), np.cos(half), strict=True,
    )  # fmt: skip
    text = ''.join(
        f'{format_stamp(t)} {x:.9f} {y:.9f} 0 0 0 {z:.12f} {w:.12f}\n' for t, x, y, z, w in rows
    )
    write_atomically(Path(path), text.encode())
