# SPDX-License-Identifier: Apache-2.0
"""Frames on their way to another process, in batches and by columns.

A frame is some twenty small objects. One by one they take longer to be written and read than what
the back end does with most frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Frame, Motion, Observation

# What the back end reads of a frame, besides the end points and the detections.
VALUES = attrgetter(
    'stamp', 'scan_score', 'scan_used', 'unconfirmed', 'jumped',
    'observation.motion.known', 'observation.motion.bias', 'observation.motion.bias_var',
)  # fmt: skip
ARRAYS = tuple(
    attrgetter(name)
    for name in (
        'T_local_base', 'cov_local',
        'observation.motion.delta', 'observation.motion.cov', 'observation.motion.bias_gain',
    )
)  # fmt: skip
NO_POINTS = np.zeros((0, 2))
NONE = np.zeros(0, dtype=np.int64)
UNSENT = np.full(
    (3, 3), np.nan
)  # in place of poses in the map, which the back end computes itself


class Batch(NamedTuple):
    """Some frames: ``values`` and ``arrays`` (n, ...) by VALUES and ARRAYS.

    ``points`` (m, 2) and ``origins`` (s, 2) are those of the frames with a scan, in their order;
    ``lengths`` (n,) are the numbers of points of the frames, -1 without a scan. ``detections`` are
    there for those frames, by number, that looked for reflectors, with the keys of these.
    """

    values: list[tuple[int, float, bool, bool, bool, bool, float, float]]
    arrays: tuple[Array, ...]
    lengths: list[int]
    points: Array
    origins: Array
    detections: dict[int, tuple[Detections, NDArray[np.int64]]]


def packed(frames: Sequence[Frame]) -> Batch:
    """What the back end needs of the frames."""
    seen = [f.observation for f in frames]
    scans = [(o.points, o.origin) for o in seen if o.points is not None]
    return Batch(
        [VALUES(f) for f in frames],
        tuple(np.array([array(f) for f in frames]) for array in ARRAYS),
        [-1 if o.points is None else len(o.points) for o in seen],
        np.concatenate([NO_POINTS, *(points for points, _ in scans)]),
        np.array([origin for _, origin in scans]),
        {
            k: (f.observation.detections, f.landmarks)
            for k, f in enumerate(frames)
            if f.observation.detections is not None
        },
    )


def unpacked(batch: Batch) -> list[Frame]:
    """The frames, without what the back end does not need."""
    frames, used, scanned = [], 0, 0
    for k, (values, pose, cov, delta, motion_cov, gain) in enumerate(
        zip(batch.values, *batch.arrays, strict=True)
    ):
        stamp, score, scan_used, unconfirmed, jumped, known, bias, bias_var = values
        motion = Motion(delta, motion_cov, known, gain, bias, bias_var)
        points = origin = None
        if (length := batch.lengths[k]) >= 0:
            points, origin = batch.points[used : used + length], batch.origins[scanned]
            used, scanned = used + length, scanned + 1
        detections, landmarks = batch.detections.get(k, (None, NONE))
        frames.append(
            Frame(
                stamp, Observation(stamp, motion, points, origin, detections), pose, cov,
                UNSENT[0], UNSENT, landmarks, NONE,
                scan_score=score, scan_used=scan_used, unconfirmed=unconfirmed, jumped=jumped,
            )
        )  # fmt: skip
    return frames
