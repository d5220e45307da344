# SPDX-License-Identifier: Apache-2.0
"""Landmark measurement models of EKF-SLAM, and their inverses.

All functions are batched and return values with their Jacobians; the equations are those of the
note with its slips corrected (docs/ekf_slam.md lists them, the tests show each).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Model:
    """A kind of landmark, two numbers in the map, measured as two numbers from the robot.

    ``observe(pose, landmarks (m, 2))`` gives h (m, 2), dh/dpose (m, 2, 3), dh/dlandmark (m, 2, 2);
    ``place(pose, z (k, 2))`` the landmark (k, 2), its J_xr (k, 2, 3) and its J_z (k, 2, 2);
    ``innovation(z, h)`` their difference, over leading dimensions. The pose is one (3,), or one
    of each landmark (m, 3).
    """

    observe: Callable[[Array, Array], tuple[Array, Array, Array]]
    place: Callable[[Array, Array], tuple[Array, Array, Array]]
    innovation: Callable[[Array, Array], Array]


def observe_points(pose: Array, landmarks: Array) -> tuple[Array, Array, Array]:
    """Range and bearing of points (eq. 17) and their Jacobian H (eq. 18)."""
    d = landmarks - pose[..., :2]
    q = d[:, 0] ** 2 + d[:, 1] ** 2
    r = np.sqrt(q)
    h = np.stack([r, se2.wrap(np.arctan2(d[:, 1], d[:, 0]) - pose[..., 2])], -1)
    H_m = np.empty((len(d), 2, 2))
    H_m[:, 0] = d / r[:, None]
    # bearing row of H: [(ly - y) / r^2, -(lx - x) / r^2, -1]; the note has the second sign wrong
    H_m[:, 1, 0], H_m[:, 1, 1] = -d[:, 1] / q, d[:, 0] / q
    H_r = np.zeros((len(d), 2, 3))
    H_r[:, :, :2] = -H_m
    H_r[:, 1, 2] = -1.0
    return h, H_r, H_m


def place_points(pose: Array, z: Array) -> tuple[Array, Array, Array]:
    """Points seen at range and bearing z (k, 2), with J_xr and J_z (last sign corrected)."""
    a = pose[..., 2] + z[:, 1]
    c, s = np.cos(a), np.sin(a)
    m = pose[..., :2] + z[:, :1] * np.stack([c, s], -1)
    J_z = np.empty((len(z), 2, 2))
    J_z[:, 0, 0], J_z[:, 0, 1] = c, -z[:, 0] * s
    J_z[:, 1, 0], J_z[:, 1, 1] = s, z[:, 0] * c
    J_xr = np.zeros((len(z), 2, 3))
    J_xr[:, 0, 0] = J_xr[:, 1, 1] = 1.0
    J_xr[:, :, 2] = J_z[:, :, 1]
    return m, J_xr, J_z


def point_innovation(z: Array, h: Array) -> Array:
    """Z - h (..., 2) with the bearing wrapped."""
    nu = np.asarray(z - h)
    nu[..., 1] = se2.wrap(nu[..., 1])
    return nu


POINT = Model(observe_points, place_points, point_innovation)


def line_model(origin: Array) -> Model:
    """Infinite lines, held as their point nearest to the fixed point ``origin`` (2,).

    A line is measured by distance and direction (rho, alpha) of the perpendicular from the robot.
    The note turns the fixed point's nearest point on the line into range and bearing "using the
    robot's position"; that measurement moves with the robot's error along the line, so the filter
    would use a position that was not measured. A line measures rho and alpha alone.
    """
    o = np.asarray(origin, dtype=np.float64)

    def observe(pose: Array, landmarks: Array) -> tuple[Array, Array, Array]:
        e = landmarks - o
        d = np.maximum(np.hypot(e[:, 0], e[:, 1]), 1e-9)
        n = e / d[:, None]
        t = np.stack([-n[:, 1], n[:, 0]], -1)
        a = np.arctan2(e[:, 1], e[:, 0])
        away = ((o - pose[..., :2])[..., None] * np.stack([n, t], -1)).sum(axis=-2)  # along n, t
        h = np.stack([d + away[:, 0], se2.wrap(a - pose[..., 2])], -1)
        H_m = np.empty((len(e), 2, 2))
        H_m[:, 1] = t / d[:, None]
        H_m[:, 0] = n + away[:, 1:] * H_m[:, 1]
        H_r = np.zeros((len(e), 2, 3))
        H_r[:, 0, :2] = -n
        H_r[:, 1, 2] = -1.0
        return h, H_r, H_m

    def place(pose: Array, z: Array) -> tuple[Array, Array, Array]:
        a = pose[..., 2] + z[:, 1]
        n = np.stack([np.cos(a), np.sin(a)], -1)
        t = np.stack([-n[:, 1], n[:, 0]], -1)
        from_origin = pose[..., :2] - o
        d = z[:, 0] + (n * from_origin).sum(axis=-1)
        by_angle = n * (t * from_origin).sum(axis=-1)[:, None] + t * d[:, None]
        J_z = np.stack([n, by_angle], -1)
        J_xr = np.empty((len(z), 2, 3))
        J_xr[:, :, :2] = n[:, :, None] * n[:, None, :]
        J_xr[:, :, 2] = by_angle
        return o + d[:, None] * n, J_xr, J_z

    return Model(observe, place, line_innovation)


def line_innovation(z: Array, h: Array) -> Array:
    """Z - h (..., 2); (rho, alpha) and (-rho, alpha + pi) are one line, the nearer one counts."""
    z, h = np.broadcast_arrays(z, h)
    nu = np.empty(z.shape)
    turn = se2.wrap(z[..., 1] - h[..., 1])
    other = np.abs(turn) > 0.5 * np.pi
    nu[..., 0] = np.where(other, -z[..., 0], z[..., 0]) - h[..., 0]
    nu[..., 1] = np.where(other, se2.wrap(turn + np.pi), turn)
    return nu


def to_polar(points: Array, cov: Array) -> tuple[Array, Array]:
    """Range and bearing (k, 2) of points in the robot's frame, and their covariances R."""
    q = np.maximum(points[:, 0] ** 2 + points[:, 1] ** 2, 1e-12)
    r = np.sqrt(q)
    J = np.empty((len(points), 2, 2))
    J[:, 0] = points / r[:, None]
    J[:, 1, 0], J[:, 1, 1] = -points[:, 1] / q, points[:, 0] / q
    z = np.stack([r, np.arctan2(points[:, 1], points[:, 0])], -1)
    return z, J @ cov @ J.transpose(0, 2, 1)
