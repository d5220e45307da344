# SPDX-License-Identifier: Apache-2.0
"""The scan term as a measurement of the joint state: the pose relative to the submap's anchor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import brief, part
from rlml_slam.se2 import Array, wrapped
from rlml_slam.slam.front_end.joint_state import ANCHORS, VELOCITY, JointState, update

TARGET = ANCHORS[0]
POSE_AND_TARGET = np.array([0, 1, 2, TARGET, TARGET + 1, TARGET + 2])
WITH_VELOCITY = np.concatenate((POSE_AND_TARGET, VELOCITY + np.arange(3)))
MIN_INFORMATION = 1e-6  # [1/m², 1/rad²] a direction that the scan holds less is left open


@part
def jacobian_of(pose: Array, turn: float) -> Array:
    """D between(anchor, X) / d (X, anchor) (3, 6) where between is ``pose`` (3,).

    ``turn`` is the anchor's heading.
    """
    c, s = math.cos(turn), math.sin(turn)
    J = np.zeros((3, 6))
    J[0, 0], J[0, 1], J[1, 0], J[1, 1], J[2, 2] = c, s, -s, c, 1.0
    J[:, 3:] = -J[:, :3]
    J[0, 5], J[1, 5] = pose[1], -pose[0]
    return J


@brief
def prior_of(
    x: Array, P: Array, floor2: Array, half: Array, velocity: Array
) -> tuple[Array, Array]:
    """The pose in the frame of the submap (3,) by the joint state, and its information (3, 3).

    ``floor2`` (3,) are variances of it that are added to those of the state; ``half`` and
    ``velocity`` (3,) as in swept(), for it is where the match is expected.
    """
    pose, _, cov = swept(x, P, half, velocity)
    information: Array = np.asarray(np.linalg.inv(cov + np.diag(floor2)), dtype=np.float64)
    return pose, information


@brief
def relative(x: Array, P: Array) -> tuple[Array, Array]:
    """The pose in the frame of the submap (3,) and its covariance (3, 3)."""
    c, s = math.cos(x[TARGET + 2]), math.sin(x[TARGET + 2])
    dx, dy, turn = x[0] - x[TARGET], x[1] - x[TARGET + 1], x[2] - x[TARGET + 2]
    pose = np.array([c * dx + s * dy, c * dy - s * dx, wrapped(turn)])
    J = jacobian_of(pose, x[TARGET + 2])
    cov = np.empty((6, 6))
    for k in range(6):
        for m in range(6):
            cov[k, m] = P[POSE_AND_TARGET[k], POSE_AND_TARGET[m]]
    return pose, np.dot(np.dot(J, cov), J.T.copy())


@brief
def swept(x: Array, P: Array, half: Array, velocity: Array) -> tuple[Array, Array, Array]:
    """Where a match finds the robot in the submap (3,), D of it (3, 9), its covariance (3, 3).

    The beams of a sweep constrain the pose at the middle of it. The pose at its begin follows by
    the ``velocity`` (3,) that they were de-skewed with, whose error moves the match by ``half``
    (3,) [s] times that error. D is by pose, anchor and velocity.
    """
    pose, cov = relative(x, P)
    J = np.zeros((3, 9))
    J[:, :6] = jacobian_of(pose, x[TARGET + 2])
    if not half.any():
        return pose, J, cov
    c, s = math.cos(pose[2]), math.sin(pose[2])
    J[0, 6], J[0, 7], J[1, 6], J[1, 7], J[2, 8] = (
        c * half[0], -s * half[1], s * half[0], c * half[1], half[2],
    )  # fmt: skip
    every = np.empty((9, 9))
    for k in range(9):
        for m in range(9):
            every[k, m] = P[WITH_VELOCITY[k], WITH_VELOCITY[m]]
    pose += np.dot(J[:, 6:].copy(), x[VELOCITY : VELOCITY + 3] - velocity)
    return pose, J, np.dot(np.dot(J, every), J.T.copy())


class Found(NamedTuple):
    """A match at ``pose`` (3,) of the submap with ``information`` (3, 3).

    It is the optimum of scan and prior, while an update wants what the scan says alone: that is
    farther by what the prior held back, ``pull`` (3,) of it over the ``curvature`` (3, 3) of the
    scan term; a prior that lost has held back nothing. A pull of zeros leaves this out.
    """

    pose: Array
    information: Array
    pull: Array
    curvature: Array


@brief
def fuse(
    x: Array, P: Array, found: Found, prior_robust_scale: float, half: Array, velocity: Array
) -> None:
    """Update ``x`` and ``P`` with a match; ``half`` and ``velocity`` are as in swept().

    Where the scan disagrees with the prior by more than ``prior_robust_scale`` sigmas, the
    prior covariance is first widened by the disagreement: the odometry was wrong by that much.
    """
    pose, information, pull, curvature = found
    prior, J, cov = swept(x, P, half, velocity)
    values, axes = np.linalg.eigh(information)
    first = 0
    while first < 3 and values[first] <= MIN_INFORMATION:
        first += 1
    if first == 3:
        return
    # the match as independent measurements of the pose in the submap, unit variance each
    rows = 3 - first
    root, inverse = np.empty((rows, 3)), np.empty((3, rows))
    for k in range(rows):
        scale = math.sqrt(values[first + k])
        root[k], inverse[:, k] = axes[:, first + k] * scale, axes[:, first + k] / scale
    offset = pose - prior
    offset[2] = wrapped(offset[2])
    v = np.dot(root, offset)
    spread = np.dot(np.dot(root, cov), root.T.copy()) + np.eye(rows)
    if np.dot(v, np.linalg.solve(spread, v)) > prior_robust_scale**2 * rows:
        seen = np.dot(J[:, :3].T.copy(), np.dot(inverse, v))
        P[:3, :3] += np.outer(seen, seen)
    else:
        for k in range(rows):
            axis = axes[:, first + k].copy()
            curved = np.dot(axis, np.dot(curvature, axis))
            v[k] += np.dot(root[k], pull) / max(curved, values[first + k])
    update(x, P, WITH_VELOCITY, np.dot(root, J), np.eye(rows), v)


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    state, zero = JointState(np.zeros(3), np.eye(3), 0.1), np.zeros(3)
    relative(state.x, state.P)
    prior_of(state.x, state.P, np.ones(3), zero, zero)
    fuse(state.x, state.P, Found(zero, np.eye(3), zero, np.eye(3)), 3.0, zero, zero)
