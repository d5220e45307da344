# SPDX-License-Identifier: Apache-2.0
"""The robot's motion over a gap of the data, in which no other sensor has seen it.

The front end takes such a motion for unknown, since a scan can show it. Here nothing can, and
what the wheels counted while the messages were lost is in the odometry's next pose.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rlml_slam.motion import integrate
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array, between, log
from rlml_slam.types import Motion


def bridge(
    motion: Motion, before: Array | None, after: Array | None, dt: float, noise: MotionNoise
) -> Motion:
    """An unknown ``motion`` over ``dt`` seconds, from the raw odometry (3,) at its ends.

    Without odometry there, or where it was reset, it stays unknown.
    """
    delta = None if before is None or after is None else between(before, after)
    if delta is None or not _is_possible(delta, dt, noise):
        # the noise of an unknown speed does not average out: it grows with the time
        longer = math.sqrt(max(dt / noise.noise_interval, 1.0))
        lasting = np.outer([longer, longer, 1.0], [longer, longer, 1.0])
        return replace(motion, cov=motion.cov * lasting)
    # as if along one arc, in pieces of an interval: what the heading errs by early moves the end
    n = max(math.ceil(dt / noise.noise_interval), 1)
    step = log(delta)
    v, w = math.hypot(step[0], step[1]) / dt, step[2] / dt
    guess = noise.long_interval_noise if n > 2 else 0.0
    sigma = np.array([
        (noise.speed_noise + guess) * v + noise.speed_noise_floor,
        (noise.turn_noise + guess) * abs(w) + noise.turn_noise_floor,
        noise.lateral_noise * v,
    ])  # fmt: skip
    piece = np.array([v, w, dt / n, *(sigma**2 * (noise.noise_interval * n / dt)), 0.0])
    return Motion(delta, integrate(*np.tile(piece[:, None], n))[1:4])


def _is_possible(delta: Array, dt: float, noise: MotionNoise) -> bool:
    over = max(dt, noise.noise_interval)
    return math.hypot(delta[0], delta[1]) <= noise.max_speed * over
