# SPDX-License-Identifier: Apache-2.0
"""The robot's motion over a gap of the data, in which no other sensor has seen it.

The front end takes such a motion for unknown, since a scan can show it. Here nothing can, and
what the wheels counted while the messages were lost is in the odometry's next pose.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rlml_slam.motion import is_possible, motion_of
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array, between
from rlml_slam.types import Motion


def bridge(
    motion: Motion, before: Array | None, after: Array | None, dt: float, noise: MotionNoise
) -> Motion:
    """An unknown ``motion`` over ``dt`` seconds, from the raw odometry (3,) at its ends.

    Without odometry there, or where it was reset, it stays unknown.
    """
    delta = None if before is None or after is None else between(before, after)
    if delta is None or not is_possible(delta, dt, noise):
        # the noise of an unknown speed does not average out: it grows with the time
        longer = math.sqrt(max(dt / noise.noise_interval, 1.0))
        lasting = np.outer([longer, longer, 1.0], [longer, longer, 1.0])
        return replace(motion, cov=motion.cov * lasting)
    return motion_of(delta, dt, noise)
