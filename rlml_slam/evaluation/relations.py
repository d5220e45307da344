# SPDX-License-Identifier: Apache-2.0
"""The relations metric of Kümmerle et al., On measuring the accuracy of SLAM algorithms, 2009.

A relation says how a robot moved between two stamps; the error of an estimate is
d = inverse(relation) * (T_1^-1 T_2). Nothing depends on the frame of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.datasets.text_file import parse_numbers, parse_stamp, read_lines
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError, InputError
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Relations:
    """``stamps`` (n, 2) int64 [ns] and ``deltas`` (n, 3): the pose at t2 seen from that at t1."""

    stamps: NDArray[np.int64]
    deltas: Array

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True)
class RelationErrors:
    """Errors of the relations that could be matched: ``trans`` [m] and ``rot`` [rad], (n,)."""

    trans: Array
    rot: Array
    unmatched: int

    def summary(self) -> dict[str, float]:
        """Mean, standard deviation and maximum of the errors, and of their squares."""
        rot = np.degrees(self.rot)
        out: dict[str, float] = {
            'relations': len(self.trans),
            'relations_unmatched': self.unmatched,
        }
        for name, unit, e in (('trans', 'm', self.trans), ('rot', 'deg', rot)):
            out[f'{name}_mean_{unit}'] = float(e.mean())
            out[f'{name}_std_{unit}'] = float(e.std())
            out[f'{name}_max_{unit}'] = float(np.max(e))
            out[f'{name}_squared_mean_{unit}2'] = float((e**2).mean())
            out[f'{name}_squared_std_{unit}2'] = float((e**2).std())
        return out


def read_relations(path: str | Path) -> Relations:
    """Lines ``t1 t2 x y z roll pitch yaw`` (also .gz, .xz); FileFormatError with the line."""
    stamps, deltas = [], []
    for number, line in read_lines(path):
        words = line.split()
        try:
            if len(words) != 8:
                raise ValueError(f'{len(words)} values, 8 expected: t1 t2 x y z roll pitch yaw')
            stamps.append((parse_stamp(words[0]), parse_stamp(words[1])))
            x, y, _, _, _, yaw = parse_numbers(words[2:])
        except ValueError as e:
            raise FileFormatError(f'{path}:{number}: {e}') from e
        deltas.append((x, y, yaw))
    if not stamps:
        raise FileFormatError(f'{path}: no relations in it')
    return Relations(np.array(stamps, dtype=np.int64), np.array(deltas))


def nearest(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the stamp nearest to each wanted one; ``stamps`` rise and are not empty."""
    right = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(wanted - stamps[left]) <= np.abs(stamps[right] - wanted)
    return np.where(is_left, left, right).astype(np.int64)


def relation_errors(
    trajectory: Trajectory,
    relations: Relations,
    tolerance: int = 1_000_000,
    max_unmatched: float = 0.1,
) -> RelationErrors:
    """Errors at the poses nearest to the stamps of each relation, within ``tolerance`` [ns].

    Raises InputError if more than ``max_unmatched`` of the relations have no pose at a stamp: a
    mean over the rest would not be comparable.
    """
    i = nearest(trajectory.stamps, relations.stamps)
    off = np.abs(trajectory.stamps[i] - relations.stamps)
    matched = (off <= tolerance).all(axis=1)
    missing = int(np.sum(~matched))
    if missing > max_unmatched * len(relations) or not matched.any():
        raise InputError(
            f'{missing} of {len(relations)} relations have no pose within '
            f'{tolerance * 1e-9:g} s of their stamps'
        )
    T_1, T_2 = trajectory.poses[i[matched, 0]], trajectory.poses[i[matched, 1]]
    d = se2.between(relations.deltas[matched], se2.between(T_1, T_2))
    return RelationErrors(np.hypot(d[:, 0], d[:, 1]), np.abs(d[:, 2]), missing)
