# SPDX-License-Identifier: Apache-2.0
"""What each keyframe did and cost, as a cloud of one point: the topic ``updates``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import build_cloud, read_table
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import Update

# x, y, z for RViz: where the keyframe was put
UPDATE = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('keyframe', '<i4'), ('optimized', 'u1'),
        ('accepted', '<i4'), ('rejected', '<i4'), ('wall_ms', '<f8'),
    ]
)  # fmt: skip


@dataclass(frozen=True)
class UpdateSummary:
    """One keyframe of the back end: loop closures that it brought, and its cost [ms]."""

    keyframe: int
    optimized: bool
    accepted: int
    rejected: int
    wall_ms: float


def build_update(make: Make, stamp: int, map_frame: str, place: Array, update: Update) -> Any:
    """PointCloud2 of one point; ``place`` (2,) [m] is the keyframe's in the map."""
    cloud = np.zeros(1, dtype=UPDATE)
    cloud['x'], cloud['y'] = place
    cloud['keyframe'], cloud['optimized'] = update.keyframe, update.optimized
    cloud['accepted'] = sum(c.accepted for c in update.closures)
    cloud['rejected'] = sum(not c.accepted for c in update.closures)
    cloud['wall_ms'] = update.wall_ms
    return build_cloud(make, encode.header(make, stamp, map_frame), cloud)


def read_update(msg: Any, topic: str = 'updates') -> UpdateSummary:
    """The inverse of build_update; InputError if it is another kind of cloud."""
    u = read_table(msg, UPDATE, topic, one=True)[0]
    return UpdateSummary(
        int(u['keyframe']), bool(u['optimized']), int(u['accepted']), int(u['rejected']),
        float(u['wall_ms']),
    )  # fmt: skip
