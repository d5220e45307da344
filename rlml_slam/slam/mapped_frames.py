# SPDX-License-Identifier: Apache-2.0
"""Which frames become part of the graph, and what it makes of them for the front end."""

from __future__ import annotations

from dataclasses import replace

from rlml_slam.motion import STILL, compose_motion
from rlml_slam.slam.back_end.back_end import Update
from rlml_slam.slam.closures.closure_table import describe
from rlml_slam.slam.conversation import Command, Correct, MapFrame, SessionFrame, warning
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.types import Belief


class MappedFrames:
    """Frames on their way to the graph; ``session`` is that of those in it, None while empty.

    While ``is_paused``, frames are left out, and their motion is added to that of the next one.
    ``jumps``: no motion leads to the next frame. ``found``: where a search has found the robot.
    ``next_key``: the first that no reflector of the map has; ``has_map``: there is something in
    the graph.
    """

    def __init__(self) -> None:
        self.is_paused = False
        self.forget()

    def forget(self) -> None:
        """The graph is empty, or another one."""
        self.session: int | None = None
        self.jumps, self._skipped = False, STILL
        self.found: FoundPose | None = None
        self.next_key, self.has_map = 0, False

    def add(self, record: SessionFrame) -> list[Command]:
        """The command to map a frame, none while paused."""
        frame = record.frame
        motion = frame.observation.motion
        if self._skipped is not STILL:
            motion = compose_motion(self._skipped, motion)
            frame = replace(frame, observation=replace(frame.observation, motion=motion))
        self._skipped = motion if self.is_paused else STILL
        if self.is_paused:
            self.jumps |= frame.jumped
            return []
        if self.jumps:
            frame, self.jumps = replace(frame, jumped=True), False
        self.session, self.has_map = record.session, True
        self.next_key = max(self.next_key, 1 + int(frame.landmarks.max(initial=-1)))
        found, self.found = self.found, None
        return [MapFrame(record.session, frame, found)]


def corrections(session: int, stamp: int, update: Update, belief: Belief | None) -> list[Command]:
    """What the front end and the user are to know of a keyframe."""
    out: list[Command] = [warning(describe(closure)) for closure in update.changed]
    if update.removed:
        keys = ', '.join(map(str, update.removed))
        out.append(warning(f'no longer seen where they were: reflectors {keys}'))
    if update.optimized:
        cov = None if update.known is None else update.known.cov_map
        out.append(Correct(session, stamp, update.T_map_local, cov, update.removed, belief))
    elif update.removed:
        out.append(Correct(session, stamp, None, removed=update.removed))
    return out
