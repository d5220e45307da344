# SPDX-License-Identifier: Apache-2.0
"""The pose of the last run in a saved map: tested at the start, written down from then on."""

from __future__ import annotations

from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import Command, Log, RememberPose, SessionFrame, info, warning
from rlml_slam.slam.relocalization.pose_test import verified
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Frame


class LastRun:
    """``pose`` (3,) of the last run, None once it was tested, or without one.

    With ``remembers``, the newest pose is written down for the next start.
    """

    def __init__(self, pose: Array | None = None, remembers: bool = False) -> None:
        self.pose = pose
        self._remembers = remembers

    def can_be_tested(self, record: SessionFrame) -> bool:
        """Whether there is a pose, and the frame has seen something."""
        seen = record.frame.observation
        return self.pose is not None and not (seen.points is None and seen.detections is None)

    def test(self, found: Relocation) -> tuple[tuple[Array, Array] | None, Log]:
        """Pose and covariance (3,), (3, 3) where the search confirms it, and what to say."""
        assert self.pose is not None
        (start, why), self.pose = verified(self.pose, found), None
        return start, warning(why) if start is None else info(why)

    def remember(self, frame: Frame) -> list[Command]:
        """The command to write down a pose, none before that of the last run was tested."""
        return [RememberPose(frame)] if self._remembers and self.pose is None else []
