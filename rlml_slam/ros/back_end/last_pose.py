# SPDX-License-Identifier: Apache-2.0
"""Where the robot was when it was switched off, beside the map: believed only where it fits.

``NAME.pose`` is one JSON object: ``x``, ``y`` [m] and ``theta`` [rad] in the map frame, ``stamp``
[ns]. It is written while the pose is sure and the robot moves.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Frame, Level, Verdict

PERIOD = 1_000_000_000  # [ns] of stamps between two files
MOVED = np.array([0.01, 0.01, 0.01])  # [m, m, rad] less is no other pose
# [m, m, rad] of a robot that nobody moved: a pose that needs more to fit is of another place
SIGMA = np.array([0.1, 0.1, 0.05])
NEAR = 5.0 * SIGMA  # a place that was found so near is the same


class LastPose:
    """The file of the last pose in one saved map."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written: tuple[int, Array] | None = None
        self.tried = False  # whether it was looked at: only the first frame can be at it

    def follow(
        self, frame: Frame, params: Parameters, in_map: SavedMap, logger: Any
    ) -> tuple[Array, Array] | None:
        """Where to start, pose (3,) and covariance (3, 3), if the first frame verifies it.

        Later frames are remembered. Raises MapError where that cannot be.
        """
        if self.tried:
            self.remember(frame)
            return None
        seen = frame.observation
        if seen.points is None and seen.detections is None:
            return None
        self.tried = True
        try:
            last = self.read()
        except FileFormatError as e:
            logger.warning(f'{e}')
            return None
        if last is None:
            return None
        start, why = verified(
            last, localize_globally(in_map.grid, in_map.reflectors, seen, params)
        )
        logger.warning(why) if start is None else logger.info(why)
        return start

    def read(self) -> Array | None:
        """The pose (3,), None where there is no file. Raises FileFormatError."""
        try:
            told = json.loads(self._path.read_text(encoding='utf-8'))
            pose = np.array([float(told[name]) for name in ('x', 'y', 'theta')])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as e:
            raise FileFormatError(f'{self._path}: no pose: {e}') from e
        if not np.isfinite(pose).all():
            raise FileFormatError(f'{self._path}: the pose is not finite')
        return pose

    def remember(self, frame: Frame) -> None:
        """Write the pose of a frame that is sure of it, if it is another one. Raises MapError."""
        if frame.health.level is not Level.OK or frame.unconfirmed:
            return
        pose = frame.T_map_base
        if self._written is not None:
            stamp, last = self._written
            still = bool((np.abs(se2.between(last, pose)) < MOVED).all())
            if still or 0 <= frame.stamp - stamp < PERIOD:
                return
        self._written = (frame.stamp, pose)
        told = dict(zip(('x', 'y', 'theta'), (float(v) for v in pose), strict=True))
        write_atomically(self._path, json.dumps({**told, 'stamp': frame.stamp}).encode())


def verified(last: Array, found: Relocation) -> tuple[tuple[Array, Array] | None, str]:
    """What to start with, pose (3,) and covariance (3, 3), or None; and why, in words.

    ``found`` is where the first frame fits in the whole map. Where it fits several places, a last
    pose that is one of them is for the front end to confirm or to reject.
    """
    x, y, theta = last
    name = f'the last pose, x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°'
    if found.verdict is Verdict.IMPOSSIBLE or found.pose is None or found.cov is None:
        return None, f'{name}, is not restored: {found.why}'
    if found.verdict is Verdict.AMBIGUOUS:
        return (last, np.diag(SIGMA**2)), f'{name}, is tried: {found.why}'
    if (np.abs(se2.between(last, found.pose)) < NEAR).all():
        return (found.pose, found.cov), f'{name}, is restored: {found.why}'
    x, y, theta = found.pose
    elsewhere = f'x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°'
    return None, f'{name}, is not restored: the robot is rather at {elsewhere}: {found.why}'
