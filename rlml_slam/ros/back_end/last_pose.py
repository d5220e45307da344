# SPDX-License-Identifier: Apache-2.0
"""Where the robot was when it was switched off, beside the map: believed only where it fits.

``NAME.pose`` is one JSON object: ``x``, ``y`` [m] and ``theta`` [rad] in the map frame, ``stamp``
[ns]. It is written while the pose is sure and the robot moves.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.se2 import Array
from rlml_slam.types import Frame, Level

PERIOD = 1_000_000_000  # [ns] of stamps between two files
MOVED = np.array([0.01, 0.01, 0.01])  # [m, m, rad] less is no other pose


class LastPose:
    """The file of the last pose in one saved map."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written: tuple[int, Array] | None = None

    def read(self) -> Array | None:
        """The pose (3,), None where there is no file. Raises FileFormatError."""
        try:
            values = json.loads(self._path.read_text(encoding='utf-8'))
            pose = np.array([float(values[name]) for name in ('x', 'y', 'theta')])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, RecursionError, OverflowError) as e:
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
        values = dict(zip(('x', 'y', 'theta'), (float(v) for v in pose), strict=True))
        write_atomically(self._path, json.dumps({**values, 'stamp': frame.stamp}).encode())
