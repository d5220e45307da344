# SPDX-License-Identifier: Apache-2.0
"""The journal of a map in the making: what the graph was given, on disk before the map is saved.

A file of containers (:mod:`rlml_slam.maps.map_container`), one appended after the other, each with
its checksums: first the parameters and the map that is continued, if there is one, then pieces of
frames, and between them the numbers of loop closures that were revoked. A process that was killed
loses at most the piece that it had not written; from the others ``recover`` makes the same map
again, to the last bit.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError
from rlml_slam.maps.map_container import Content, pack, read_pieces
from rlml_slam.maps.survey import Survey
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Frame, Motion, Observation

Given = tuple[Frame, FoundPose | None]

FORMAT, VERSION = 'rlml_slam journal', 2
FRAME = np.dtype(
    [
        ('stamp', '<i8'), ('T_local', '<f8', 3), ('cov_local', '<f8', (3, 3)),
        ('delta', '<f8', 3), ('cov', '<f8', (3, 3)), ('known', '?'), ('scan_score', '<f8'),
        ('scan_used', '?'), ('unconfirmed', '?'), ('jumped', '?'), ('origin', '<f8', 2),
        ('points', '<i4'), ('detections', '<i4'),  # how many; -1: none
        ('found', '<f8', 7),  # T_local, T_map and area of a FoundPose; NaN: none
    ]
)  # fmt: skip
DETECTION = np.dtype(
    [
        ('point', '<f8', 2), ('cov', '<f8', (2, 2)), ('id', '<i8'), ('diameter', '<f8'),
        ('landmark', '<i8'), ('status', '<i8'),
    ]
)  # fmt: skip


class Journal:
    """Frames, kept until ``write`` appends them to the open file. OSError where that fails."""

    def __init__(self, params: Parameters, base: Content | None = None) -> None:
        description = {
            'format': FORMAT, 'version': VERSION, 'parameters': dataclasses.asdict(params),
            'base': None if base is None else dict(base.description),
        }  # fmt: skip
        self._head: Content | None = Content({} if base is None else base.arrays, description)
        self._frames: list[Given] = []
        self._pieces: list[Content] = []  # what came before the frames

    def add(self, frame: Frame, is_keyframe: bool, found: FoundPose | None = None) -> None:
        """A frame that the graph was given; only keyframes need their scans."""
        observation = dataclasses.replace(frame.observation, scan=None)
        if not is_keyframe:
            observation = dataclasses.replace(observation, points=None)
        self._frames.append((dataclasses.replace(frame, observation=observation), found))

    def revoke(self, number: int) -> None:
        """A loop closure that the graph has revoked."""
        if self._frames:
            self._pieces.append(_piece(self._frames))
            self._frames.clear()
        self._pieces.append(Content({}, {'format': FORMAT, 'revoked': number}))

    def write(self, file: IO[bytes]) -> None:
        """Append what has come since the last call, and have it on the disk."""
        if self._head is not None:
            file.writelines(pack(self._head))
            self._head = None
        for piece in self._pieces:
            file.writelines(pack(piece))
        self._pieces.clear()
        if self._frames:
            file.writelines(pack(_piece(self._frames)))
            self._frames.clear()
        file.flush()
        os.fsync(file.fileno())


def _piece(frames: list[Given]) -> Content:
    rows = np.zeros(len(frames), dtype=FRAME)
    seen: list[NDArray[np.void]] = [np.zeros(0, dtype=DETECTION)]
    scans: list[NDArray[np.float32]] = [np.zeros((0, 2), dtype=np.float32)]
    for row, (frame, found) in zip(rows, frames, strict=True):
        o, motion, d = frame.observation, frame.observation.motion, frame.observation.detections
        row['stamp'], row['T_local'], row['cov_local'] = (
            frame.stamp, frame.T_local_base, frame.cov_local,
        )  # fmt: skip
        row['delta'], row['cov'], row['known'] = motion.delta, motion.cov, motion.known
        for name in ('scan_score', 'scan_used', 'unconfirmed', 'jumped'):
            row[name] = getattr(frame, name)
        row['origin'] = np.nan if o.origin is None else o.origin
        row['points'] = -1 if o.points is None else len(o.points)
        row['detections'] = -1 if d is None else len(d)
        row['found'] = np.nan
        if found is not None:
            row['found'] = *found.T_local, *found.T_map, found.area
        if o.points is not None:
            scans.append(o.points.astype(np.float32))
        if d is not None:
            table = np.zeros(len(d), dtype=DETECTION)
            table['point'], table['cov'], table['id'] = d.points, d.cov, d.ids
            table['diameter'] = d.diameters
            table['landmark'], table['status'] = frame.landmarks, frame.statuses
            seen.append(table)
    arrays = {'frames': rows, 'detections': np.concatenate(seen), 'points': np.concatenate(scans)}
    return Content(arrays, {'format': FORMAT})


def frames_of(piece: Content) -> Iterator[Given]:
    """The frames of a piece, with what a graph needs of them, and where the robot was found."""
    rows, seen, points = (piece.arrays[name] for name in ('frames', 'detections', 'points'))
    none = np.zeros(0, dtype=np.int64)
    for r in rows:
        d, scan, table = None, None, np.zeros(0, dtype=DETECTION)
        stamp = int(r['stamp'])
        if r['points'] >= 0:
            scan, points = points[: r['points']], points[r['points'] :]
        if r['detections'] >= 0:
            table, seen = seen[: r['detections']], seen[r['detections'] :]
            d = Detections(stamp, '', table['point'], table['cov'], table['id'], table['diameter'])
        origin = None if np.isnan(r['origin']).any() else r['origin'].copy()
        motion = Motion(r['delta'].copy(), r['cov'].copy(), bool(r['known']))
        T, cov = r['T_local'].copy(), r['cov_local'].copy()
        pose = r['found'].copy()
        found = None if np.isnan(pose).any() else FoundPose(pose[:3], pose[3:6], float(pose[6]))
        yield Frame(
            stamp, Observation(stamp, motion, scan, origin, d), T, cov, T, cov,
            table['landmark'] if len(table) else none, table['status'] if len(table) else none,
            scan_score=float(r['scan_score']), scan_used=bool(r['scan_used']),
            unconfirmed=bool(r['unconfirmed']), jumped=bool(r['jumped']),
        ), found  # fmt: skip


def has_base(path: Path) -> bool:
    """Whether the map of a journal continues a saved one. Raises MapError if it is not there."""
    head = next(read_pieces(path), None)
    return head is not None and head.description.get('base') is not None


def recover(
    path: Path, survey: Survey | None = None, check: Callable[[], None] = lambda: None
) -> tuple[BackEnd, Parameters]:
    """The graph that a journal was written for, and the parameters that it was made with.

    ``check`` is called before each frame, and may raise to end it. Raises MapError if the file
    cannot be read, FileFormatError if its first part is damaged.
    """
    pieces = read_pieces(path)
    head = next(pieces, None)
    if head is None or head.description.get('format') != FORMAT:
        raise FileFormatError(f'{path}: not a journal, or damaged at its beginning')
    if head.description.get('version') != VERSION:
        raise FileFormatError(f'{path}: a journal of another version')
    params = map_file.parameters_of(head)
    back_end = BackEnd(params, survey)
    base = head.description.get('base')
    if base is not None:
        map_file.restore(Content(head.arrays, base), back_end)
    for piece in pieces:
        with map_file.consistent():
            if 'revoked' in piece.description:
                back_end.revoke(int(piece.description['revoked']))
                continue
            for frame, found in frames_of(piece):
                check()
                back_end.add(frame, found)
    return back_end, params
