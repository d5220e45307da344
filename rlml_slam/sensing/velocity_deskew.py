# SPDX-License-Identifier: Apache-2.0
"""Deskew of the scans of a robot without odometry, by the velocity of its state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import project, sweep_time
from rlml_slam.types import Observation


@dataclass(frozen=True)
class Sweep:
    """What a sweep was de-skewed with: ``velocity`` (3,) [m/s, m/s, rad/s] of the base.

    ``half`` (3,) [s] is half of its time for each component, 0 for one that was measured; a scan
    without ray times, or that odometry de-skewed, has zeros.
    """

    half: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))


def deskewed(
    observation: Observation, velocity: Array, max_range: float
) -> tuple[Observation, Sweep]:
    """The observation with its end points at its stamp, by the velocity (3,) of the base.

    If a gyro measured the turn of the sweep, that is used.
    """
    scan, T = observation.scan, observation.T_base_laser
    lasted = 0.0 if scan is None else sweep_time(scan)
    if scan is None or T is None or lasted == 0.0:
        return observation, Sweep()
    half, twists = np.full(3, 0.5 * lasted), velocity[None] * lasted
    if observation.motion.bias_gain.any() and observation.sweep is not None:
        arcs = len(observation.sweep)
        twists = np.arange(1, arcs + 1)[:, None] / arcs * twists
        half[2], twists[:, 2] = 0.0, observation.sweep[:, 2]
    sweep = se2.exp(twists)
    points = project(scan, T, sweep, max_range)
    return replace(observation, points=points, sweep=sweep), Sweep(half, velocity.copy())
