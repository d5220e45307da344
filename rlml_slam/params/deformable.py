# SPDX-License-Identifier: Apache-2.0
"""Sliding-window SLAM on a deforming carrier."""

from __future__ import annotations

from dataclasses import dataclass

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class Deformable(Group):
    """Sliding window over the robot and the features of a moving, deforming carrier."""

    window: int = param(15, 'steps in the window; older ones are marginalized', '', 2, 200)
    drift: float = param(
        0.05,
        'random walk of each feature relative to the nominal motion of the carrier',
        'm/sqrt(s)',
        1e-4,
        10.0,
    )
    common_drift: float = param(
        0.05,
        'random walk of the whole carrier relative to its nominal motion',
        'm/sqrt(s)',
        0.0,
        10.0,
    )
    feature_timeout: float = param(
        5.0, 'a feature without a detection for this long is dropped', 's', 0.1, 1e4
    )
    candidate_timeout: float = param(
        1.0, 'a feature with few detections is dropped after this time', 's', 0.05, 1e4
    )
    start_sigma: tuple[float, ...] = param(
        (1e-3, 1e-3, 1e-4), 'uncertainty of the first pose, 1 sigma', 'm, m, rad', 0.0, 100.0
    )
    max_iterations: int = param(
        5, 'largest number of Gauss-Newton iterations per update', '', 1, 100
    )
    tolerance: float = param(
        1e-4, 'iterations stop when no state changes by more than this', 'm or rad', 1e-12, 1.0
    )
    motion_floor: float = param(
        2e-4,
        'noise added to that of the odometry, so that it is not zero at standstill',
        'm/sqrt(s), rad/sqrt(s)',
        1e-6,
        1.0,
    )
    velocity_timeout: float = param(
        1.0, 'DEGRADED if carrier_velocity is older or further ahead; still used', 's', 0.01, 1e4
    )
    suggest: str = param(
        'off',
        'publish on cmd_vel_suggested the motion that observes the features best, for this drive',
        choices=('off', 'omnidirectional', 'differential'),
    )
    plan_step: float = param(1.0, 'duration of each of the 6 steps of a plan', 's', 0.05, 60.0)
    plan_offset: float = param(
        0.5,
        'largest difference between a suggested velocity and that of the carrier',
        'm/s',
        0.01,
        10.0,
    )
