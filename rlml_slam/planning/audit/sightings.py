# SPDX-License-Identifier: Apache-2.0
"""The detections of a run, one scan per step of travel: what an audit needs, of bounded size."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.maps.map_container import Content
from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Frame, Level

STEP, TURN = 0.1, 0.1  # [m], [rad] of motion from one scan to the next
MOST = 200_000  # scans and detections: with more, every second scan goes, and the step is doubled
REASONS = 64  # different reasons of bad health; the others are counted as one
OTHER = 'other reasons'
SHAPES = {
    'stamps': 'n', 'poses': 'n 3', 'covs': 'n 3 3', 'levels': 'n', 'reasons': 'n', 'origin': '2',
    'scan': 'k', 'points': 'k 2', 'cov': 'k 2 2',
}  # fmt: skip


@dataclass(frozen=True)
class Sightings:
    """Scans (n,) and their detections (k,).

    ``poses`` (n, 3) of base and ``covs`` (n, 3, 3) in the map frame, ``levels`` of health, and
    ``reasons`` of it, rows of ``texts``. ``origin`` (2,) is the laser in the base frame. Of each
    detection: ``scan``, its row of the scans; ``points`` (k, 2), ``cov`` (k, 2, 2) in the base
    frame.
    """

    stamps: NDArray[np.int64]
    poses: Array
    covs: Array
    levels: NDArray[np.int64]
    reasons: NDArray[np.int64]
    texts: NDArray[np.str_]
    origin: Array
    scan: NDArray[np.int64]
    points: Array
    cov: Array

    @property
    def lasers(self) -> Array:
        """Positions (n, 2) of the laser in the map frame."""
        return se2.transform(self.poses, np.tile(self.origin, (len(self.poses), 1, 1)))[:, 0]


@dataclass
class SightingLog:
    """Collects the scans of frames in which the detector ran: a frame and its detections."""

    _rows: list[tuple[int, Array, Array, int, str, Array | None, Detections]] = field(
        default_factory=list
    )
    _step: float = 1.0
    _size: int = 0

    def add(self, f: Frame) -> None:
        """Keep a frame if it is far enough from the last one that was kept."""
        o = f.observation
        if o.detections is None:
            return
        if self._rows and not f.jumped:
            moved = np.abs(se2.between(self._rows[-1][1], f.T_map_base))
            if np.hypot(*moved[:2]) < STEP * self._step and moved[2] < TURN * self._step:
                return
        self._rows.append((f.stamp, f.T_map_base, f.cov_map, int(f.health.level),
                           '; '.join(f.health.reasons), o.origin, o.detections))  # fmt: skip
        self._size += 1 + len(o.detections)
        if self._size > MOST:
            self._rows = self._rows[::2]
            self._size = sum(1 + len(row[-1]) for row in self._rows)
            self._step *= 2.0

    def __len__(self) -> int:
        return len(self._rows)

    def sightings(self, stamps: NDArray[np.int64], poses: Array) -> Sightings:
        """All of them, with the ``poses`` (t, 3) of a trajectory where it has their stamps."""
        mine, at, covs, levels, reasons, origins, seen = zip(*self._rows, strict=True)
        better = dict(zip(stamps.tolist(), poses, strict=True))
        texts = [*list(dict.fromkeys(reasons))[:REASONS], OTHER]
        index = {t: k for k, t in enumerate(texts)}
        return Sightings(
            np.array(mine), np.array([better.get(s, x) for s, x in zip(mine, at, strict=True)]),
            np.array(covs), np.array(levels),
            np.array([index.get(t, len(texts) - 1) for t in reasons]), np.array(texts),
            next((o for o in origins if o is not None), np.zeros(2)),
            np.repeat(np.arange(len(seen)), [len(d) for d in seen]),
            np.concatenate([d.points for d in seen]), np.concatenate([d.cov for d in seen]),
        )  # fmt: skip


def save(sightings: Sightings, path: Path) -> None:
    """Write them: the same bytes for the same run."""
    arrays = dict(vars(sightings))
    texts = arrays.pop('texts').tolist()
    write_atomically(path, *map_container.pack(Content(arrays, {'texts': texts})))


def load(path: Path) -> Sightings:
    """Read them. Raises MapError if there are none, FileFormatError if they are malformed."""
    if not path.exists():
        raise MapError(f'{path}: not there: is it the folder of rlml replay, with reflectors?')
    arrays, description = map_container.read(path)
    map_container.require(path, arrays, SHAPES)
    texts = np.array(description.get('texts', []), dtype=np.str_)
    s = Sightings(texts=texts, **{name: arrays[name] for name in SHAPES})
    is_sound = all(np.isfinite(a).all() for a in arrays.values())
    for a, end in ((s.scan, len(s.stamps)), (s.reasons, texts.size), (s.levels, len(Level))):
        is_sound &= a.dtype.kind == 'i' and bool(((a >= 0) & (a < end)).all())
    if not is_sound:
        raise FileFormatError(f'{path}: not as a replay writes it')
    return s
