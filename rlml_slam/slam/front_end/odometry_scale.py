# SPDX-License-Identifier: Apache-2.0
"""What shows how wheels err for long: how far the robot came, by what was known before.

The joint state has the shares by which it is faster and turns more than its wheels tell. What a
share changes is in proportion to the true motion, but to take that of the wheels for it is wrong:
to divide what scans say by what wheels say is to take the noise of the latter for a share, lower
than the true one by noise^2 / motion^2 (the attenuation of errors in variables). The motion before
is as large, and its noise another one: it is the instrument of instrumental variables (Reiersøl
1941). Within the floor of the noise it tells nothing of a share.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array

FRESH = 1.0  # [s] for which a robot goes on about as it went: it takes as long to stop


def went_on(velocity: Array, dt: float, noise: MotionNoise) -> Array:
    """Way and turn (2,) [m, rad] in ``dt`` [s] at a velocity (3,), less the floors of noise.

    None where the robot may have gone on in another way, or the velocity is that of a pose that
    was put right: such a motion tells nothing of a share. Today's wheels must not bound it, or
    their noise would be in it again.
    """
    v, w = float(velocity[0]), float(velocity[2])
    if dt > FRESH or abs(v) > noise.max_speed or abs(w) > noise.max_turn_rate:
        return np.zeros(2)
    return np.array(
        [
            dt * math.copysign(max(abs(v) - noise.speed_noise_floor, 0.0), v),
            dt * math.copysign(max(abs(w) - noise.turn_noise_floor, 0.0), w),
        ]
    )
