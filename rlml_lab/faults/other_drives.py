# SPDX-License-Identifier: Apache-2.0
"""The same drive as another one: mirrored, or backwards in time, with its reference.

Nothing about the building, the laser or the odometry becomes harder, so the error should stay as
it is. What it differs by is luck: an estimate that holds for a recording holds for these as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from rlml_lab.faults.recording import Message, Recording
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.relations import Relations
from rlml_slam.types import Detections, Imu, Odometry, Scan

FLIP = np.array([1.0, -1.0, -1.0])  # of a pose, in the x axis
SWAP = np.outer(FLIP[:2], FLIP[:2])  # of a covariance of a point


def as_recorded(recording: Recording) -> Recording:
    """The drive itself."""
    return recording


def mirrored(recording: Recording) -> Recording:
    """Left and right are swapped; scans are not deskewed, their beams come in the other order."""
    relations, truth = recording.relations, recording.truth
    return replace(
        recording,
        name=f'{recording.name}, mirrored',
        messages=[_mirrored(m) for m in recording.messages],
        sensors={frame: pose * FLIP for frame, pose in recording.sensors.items()},
        relations=relations and Relations(relations.stamps, relations.deltas * FLIP),
        truth=truth and Trajectory(truth.stamps, truth.poses * FLIP),
    )


def _mirrored(m: Message) -> Message:
    if isinstance(m, Odometry):
        return replace(m, pose=np.asarray(m.pose) * FLIP)
    if isinstance(m, Imu):
        return replace(m, yaw_rate=-m.yaw_rate)
    if isinstance(m, Detections):
        return replace(m, points=m.points * FLIP[:2], cov=m.cov * SWAP)
    last = m.angle_min + (len(m.ranges) - 1) * m.angle_increment
    return replace(
        m, angle_min=-last, time_increment=0.0,
        ranges=m.ranges[::-1].copy(), intensities=m.intensities[::-1].copy(),
    )  # fmt: skip


def backwards(recording: Recording) -> Recording:
    """The last message comes first."""
    both = recording.start + recording.end
    relations, truth = recording.relations, recording.truth

    def turned(m: Message) -> Message:
        if isinstance(m, Scan):
            return replace(m, stamp=both - m.stamp, time_increment=-m.time_increment)
        if isinstance(m, Imu):
            return replace(m, stamp=both - m.stamp, yaw_rate=-m.yaw_rate)
        return replace(m, stamp=both - m.stamp)

    ordered = sorted(recording.messages, key=lambda m: m.stamp)
    return replace(
        recording,
        name=f'{recording.name}, backwards',
        messages=[turned(m) for m in reversed(ordered)],
        relations=relations and Relations(both - relations.stamps, relations.deltas),
        truth=truth and Trajectory(both - truth.stamps[::-1], truth.poses[::-1]),
    )


DRIVES: Mapping[str, Callable[[Recording], Recording]] = {
    'recorded': as_recorded,
    'mirrored': mirrored,
    'backwards': backwards,
    'mirrored-backwards': lambda r: mirrored(backwards(r)),
}
