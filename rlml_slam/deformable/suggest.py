# SPDX-License-Identifier: Apache-2.0
"""The active controller for a live robot: how to move so that the features are seen best."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.deformable.active import HORIZON, choose_control, offsets
from rlml_slam.deformable.model import Noise, Sensor
from rlml_slam.deformable.window import CarrierVelocity, WindowEstimate
from rlml_slam.params import DeformableParameters
from rlml_slam.se2 import Array, log, rotation

NO_EDGES = np.zeros((0, 2), dtype=np.int64)


def suggest_twist(
    estimate: WindowEstimate, velocity: CarrierVelocity, params: DeformableParameters
) -> Array | None:
    """Twist (v_x, v_y, omega) in the robot's frame [m/s, rad/s]; None without known features.

    The plan is to keep up with the carrier; the first of its steps is offset by the candidate
    whose predicted covariances are the smallest. The carrier's own random walk counts as that of
    each feature.
    """
    p = params.deformable
    if len(estimate.features.keys) == 0:
        return None
    dt, turn = p.plan_step, velocity.angular * p.plan_step
    keep_up = rotation(estimate.pose[2]).T @ velocity.linear * dt
    planned = np.tile(np.append(keep_up, turn), (HORIZON, 1))
    translation = np.stack([rotation(k * turn) @ velocity.linear * dt for k in range(HORIZON)])
    best = planned[0].copy()
    choose_control(
        np.concatenate([estimate.pose, estimate.features.points.ravel()]), estimate.joint_cov,
        planned, translation, offsets() * p.plan_offset * dt, NO_EDGES,
        _noise(params, velocity), _sensor(params), best,
    )  # fmt: skip
    return (drivable(best) if p.suggest == 'differential' else best) / dt


def drivable(displacement: Array) -> Array:
    """(length, 0, turn) of the arc, forwards or backwards, to a displacement (3,) of the base.

    The turn is the one that the arc takes: where a robot with two wheels goes, it points.
    """
    x, y = float(displacement[0]), float(displacement[1])
    if math.hypot(x, y) < 1e-9:
        return np.array([0.0, 0.0, displacement[2]])
    turn = 2.0 * (math.atan2(y, x) if x >= 0.0 else math.atan2(-y, -x))
    return np.array([log(np.array([x, y, turn]))[0], 0.0, turn])


def _noise(params: DeformableParameters, velocity: CarrierVelocity) -> Noise:
    """Noise of one step of the plan at the carrier's speed."""
    m, p = params.motion, params.deformable
    scale = math.sqrt(m.noise_interval * p.plan_step)
    speed = float(np.hypot(*velocity.linear))
    return Noise(
        heading=(m.turn_noise * abs(velocity.angular) + m.turn_noise_floor) * scale,
        position=(m.speed_noise * speed + m.speed_noise_floor) * scale,
        drift2=(p.drift**2 + p.common_drift**2) * p.plan_step,
    )


def _sensor(params: DeformableParameters) -> Sensor:
    """Noise per axis that grows from the range's to the bearing's at the largest range."""
    r = params.reflector
    far = max(r.sigma_range, r.sigma_bearing * r.max_range)
    return Sensor(0.0, r.max_range, r.sigma_range, far)


def warm_up() -> None:
    """Compile the kernel."""
    plan = np.zeros((1, 3))
    choose_control(
        np.zeros(5), np.eye(5), plan, np.zeros((1, 2)), offsets(), NO_EDGES, Noise(),
        Sensor(0.0, 1.0, 0.1, 0.1), plan[0].copy(),
    )  # fmt: skip
