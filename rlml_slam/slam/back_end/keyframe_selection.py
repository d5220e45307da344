# SPDX-License-Identifier: Apache-2.0
"""Keyframes: their selection, the odometry edge between two of them, the grid of their scans."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rlml_slam import params, se2
from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Interval, Keyframe
from rlml_slam.types import Frame

GATE = 3.0  # [sigma]
MOVED = 0.02  # [m], [rad] below which the robot stands still


def is_keyframe(last: Keyframe | None, frame: Frame, p: params.BackEnd) -> bool:
    """Whether a frame becomes a keyframe: by travel, heading or time since the last one."""
    if last is None:
        return True
    if frame.unconfirmed or frame.jumped:
        return frame.jumped  # nothing is mapped while the pose is unknown
    step = se2.between(last.T_local, frame.T_local_base)
    distance, turn = math.hypot(step[0], step[1]), abs(step[2])
    if distance >= p.minimum_travel_distance or turn >= p.minimum_travel_heading:
        return True
    moved = distance > MOVED or turn > MOVED
    return moved and (frame.stamp - last.stamp) * 1e-9 >= p.minimum_time


def odometry_edge(
    last: Keyframe, frame: Frame, interval: Interval, p: params.BackEnd
) -> tuple[Array, Array]:
    """Relative pose (3,) of a frame from the last keyframe, and its covariance (3, 3)."""
    since = interval.motion
    # With scans the front end's motion is the better mean. Without, it contains the reflectors,
    # which have factors of their own; but without odometry it is used all the same, for the
    # covariance is then so large that it hardly counts.
    use_front_end = interval.scanned or not since.known
    delta = se2.between(last.T_local, frame.T_local_base) if use_front_end else since.delta
    if p.edge_covariance == 'sum':
        # eq. 14 as printed, in the axes of the last keyframe
        both = last.cov_local + frame.cov_local
        return delta, se2.rotate_cov(both, -last.T_local[2]) + 1e-9 * np.eye(3)
    return delta, since.cov + np.diag(np.array(p.edge_variance_floor))


def leaves_submap(last: Keyframe, frame: Frame, sigma: Array) -> bool:
    """Whether the front end does not know where a frame is relative to the last keyframe.

    So it is after a gap whose end matched nothing. What the pose became less certain by since
    then, in the axes of the robot, is compared with the ``sigma`` (3,) of a keyframe in its
    submap. The error of the heading that both have in common is no part of it.
    """
    delta = se2.between(last.T_local, frame.T_local_base)
    J, _ = se2.compose_jacobians(last.T_local, delta)
    grown = frame.cov_local - J @ last.cov_local @ J.T
    grown = se2.rotate_cov(grown, -frame.T_local_base[2])
    return bool((np.diag(grown) > (GATE * sigma) ** 2).any())


def keyframe_of(index: int, frame: Frame, last: Keyframe | None) -> Keyframe:
    """Keyframe of a frame after ``last``; without its scan, if the front end did not match it."""
    o = frame.observation
    is_mapped = frame.scan_used or last is None
    points = o.points.astype(np.float32) if is_mapped and o.points is not None else None
    key = Keyframe(
        index, frame.stamp, frame.T_local_base, frame.cov_local,
        points, o.origin if is_mapped else None, frame.stamp, jumped=frame.jumped,
    )  # fmt: skip
    if last is not None:
        key.number, key.scan_stamp = last.number + 1, max(frame.stamp, last.scan_stamp + 1)
    return key


def draw(poses: Array, keys: Sequence[Keyframe], resolution: float) -> OccupancyGrid | None:
    """Occupancy grid of the keyframes' scans at ``poses`` (n, 3), None without any scan."""
    drawn = [k for k in keys if k.points is not None and len(k.points)]
    if not drawn:
        return None
    return render(
        poses[[k.index for k in drawn]],
        [k.points for k in drawn if k.points is not None],
        [k.origin for k in drawn if k.origin is not None],
        resolution,
    )
