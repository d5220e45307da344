# SPDX-License-Identifier: Apache-2.0
"""The factors of the graph: batched pure functions (residual, J_0, J_1), eq. 31-34.

Every residual is "predicted minus measured" and every Jacobian is with respect to the raw
coordinates (x, y, theta) or (x, y) of its nodes, so an update adds to them and wraps theta. For
(R, t) as separate coordinates this is the same step as the right-multiplied update of g2o, up to
the rotation of the translation's axes.

Which Log: ``e = Log(D_ij^-1 X_i^-1 X_j)`` is read as the chart (x, y, theta) of that pose, not as
the group logarithm. Both agree to first order at e = 0, where the covariance of an edge is
stated; the chart is what g2o, SE-Sync's datasets and GTSAM's default mean, so chi2 can be compared
with theirs, and it is smooth in the translation where the group logarithm is singular
(|theta| = pi).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rlml_slam.se2 import Array, between, rotation, wrap


def relative_pose(X_i: ArrayLike, X_j: ArrayLike, delta: ArrayLike) -> tuple[Array, Array, Array]:
    """E = chart(delta^-1 X_i^-1 X_j) ``(..., 3)``, J_i and J_j ``(..., 3, 3)``; delta = T_i_j."""
    X_i, X_j, delta = (np.asarray(a, dtype=np.float64) for a in (X_i, X_j, delta))
    p = between(X_i, X_j)
    e = between(delta, p)
    # e_xy = R_delta^T (R_i^T (t_j - t_i) - t_delta), e_theta = theta_j - theta_i - theta_delta
    Rt = np.swapaxes(rotation(X_i[..., 2] + delta[..., 2]), -1, -2)
    J_j = np.zeros((*e.shape, 3))
    J_j[..., :2, :2] = Rt
    J_j[..., 2, 2] = 1.0
    J_i = -J_j
    c, s = np.cos(delta[..., 2]), np.sin(delta[..., 2])
    # d R_i^T v / d theta_i = (p_y, -p_x) for p = R_i^T v
    J_i[..., 0, 2] = c * p[..., 1] - s * p[..., 0]
    J_i[..., 1, 2] = -s * p[..., 1] - c * p[..., 0]
    return e, J_i, J_j


def pose_landmark(X: ArrayLike, m: ArrayLike, z: ArrayLike) -> tuple[Array, Array, Array]:
    """E = R(theta)^T (m - p) - z ``(..., 2)``, J_X ``(..., 2, 3)``, J_m ``(..., 2, 2)``.

    ``z`` is the (x, y) of the landmark seen from the pose. Eq. 2 writes z - R^T (m - p);
    the sign is chosen here so that all factors are predicted minus measured.
    """
    X, m, z = (np.asarray(a, dtype=np.float64) for a in (X, m, z))
    Rt = np.swapaxes(rotation(X[..., 2]), -1, -2)
    p = (Rt @ (m - X[..., :2])[..., None])[..., 0]
    J_m = np.broadcast_to(Rt, (*p.shape, 2)).copy()
    J_X = np.zeros((*p.shape, 3))
    J_X[..., :2] = -J_m
    J_X[..., 0, 2] = p[..., 1]
    J_X[..., 1, 2] = -p[..., 0]
    return p - z, J_X, J_m


def pose_prior(X: ArrayLike, prior: ArrayLike) -> tuple[Array, Array]:
    """E = (p - p_0, theta - theta_0) ``(..., 3)`` in the axes of the map, J = identity."""
    e = np.asarray(X, dtype=np.float64) - np.asarray(prior, dtype=np.float64)
    e[..., 2] = wrap(e[..., 2])
    return e, np.broadcast_to(np.eye(3), (*e.shape, 3)).copy()


def landmark_prior(m: ArrayLike, prior: ArrayLike) -> tuple[Array, Array]:
    """E = m - m_0 ``(..., 2)`` (a surveyed reflector), J = identity."""
    e = np.asarray(m, dtype=np.float64) - np.asarray(prior, dtype=np.float64)
    return e, np.broadcast_to(np.eye(2), (*e.shape, 2)).copy()


def relative_information(delta: ArrayLike, cov: ArrayLike) -> Array:
    """Information ``(..., 3, 3)`` of relative_pose from the covariance of delta.

    ``cov`` is that of the coordinates of ``delta`` (in the axes of frame i, as types.Motion has
    it); the residual lives in the axes of the measured frame j, so it is rotated by R_delta^T.
    """
    cov = np.asarray(cov, dtype=np.float64)
    B = np.zeros_like(cov)
    B[..., :2, :2] = rotation(np.asarray(delta, dtype=np.float64)[..., 2])
    B[..., 2, 2] = 1.0
    information: Array = np.swapaxes(B, -1, -2) @ np.linalg.inv(cov) @ B
    return 0.5 * (information + np.swapaxes(information, -1, -2))


def chi2(e: Array, information: Array) -> Array:
    """Squared Mahalanobis norm e^T I e ``(...)``."""
    return np.asarray(np.einsum('...i,...ij,...j->...', e, information, e))
