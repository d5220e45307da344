# SPDX-License-Identifier: Apache-2.0
"""The factors of the graph: kinds, residuals and Jacobians, eq. 31-34.

A factor joins node i, a pose (t_i, theta_i), to node j, a pose or a landmark; a prior has node j
alone, with t_i = 0 and theta_i = 0. With d = t_j - t_i, axes R (a rotation), a measured point z
and angle, the residual and its Jacobians are

    e   = (R^T d - z, wrap(theta_j - theta_i - theta_z))
    J_j = diag(R^T, 1),   J_i = -J_j A,   A = [1 0 -d_y; 0 1 d_x; 0 0 1],

without the row and column of the angle where j is a landmark. The kinds differ in their axes:

    relative pose     R = R(theta_i + theta_delta), z = R_delta^T t_delta, theta_z = theta_delta
    landmark sighted  R = R(theta_i), z the landmark in the frame of the pose
    prior             R = 1, z the value
    range             R = [d / |d|, ...], z = (r, 0), information diag(1 / sigma^2, 0)

The first row of a range is e = |m - p| - r: J_j = d^T / |d|, and J_i = -J_j with a 0 for the
heading, for d^T / |d| A has none. Its second row has no information and does not count.

Residuals are predicted minus measured. Jacobians are with respect to the raw coordinates
(x, y, theta) or (x, y) of the nodes, so an update adds to them and wraps theta. For (R, t) as
separate coordinates this is the same step as the right-multiplied update of g2o, up to the
rotation of the translation's axes.

Which Log: ``e = Log(D_ij^-1 X_i^-1 X_j)`` is read as the chart (x, y, theta) of that pose, not as
the group logarithm. Both agree to first order at e = 0, where the covariance of an edge is
stated; the chart is what g2o, SE-Sync's datasets and GTSAM's default mean, so chi2 can be compared
with theirs, and it is smooth in the translation where the group logarithm is singular
(|theta| = pi).

Each equation is written once, as a ``formula``: the batch solver, the incremental solver with its
relinearization test, the cost and the batched functions below evaluate the same lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rlml_slam.compiled import formula
from rlml_slam.graph.model.robust_loss import Loss
from rlml_slam.se2 import Array, between, rotation, wrap


class FactorKind(IntEnum):
    """What a factor stands for; the first three are types.EdgeKind."""

    ODOMETRY = 0
    SCAN = 1
    CLOSURE = 2
    REFLECTOR = 3
    POSE_PRIOR = 4
    LANDMARK_PRIOR = 5
    RANGE = 6


# residuals (x, y, theta) that count, by FactorKind; the others have no information
COUNTED = np.array([
    [1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 1], [1, 1, 0], [1, 0, 0],
], dtype=np.bool_)  # fmt: skip
NUM_RESIDUALS = COUNTED.sum(-1)
RANGE = int(FactorKind.RANGE)
SQUARE = Loss()  # no robust loss: the squared norm itself
# Below this distance [m] a range has no direction; that of the x axis stands in, so that its
# Jacobian is of length 1 there as everywhere (any unit vector is a subgradient of |d| at 0).
MIN_DISTANCE = 1e-9
# Information of a range in linear problems, as a share of its own: it keeps a beacon without any
# other factor determined, near the poses that heard it, and leaves everything else as it is.
LINEAR_SHARE = 1e-6


@dataclass(frozen=True)
class Losses:
    """The loss of each kind of factor, by its name in lower case."""

    odometry: Loss = SQUARE
    scan: Loss = SQUARE
    closure: Loss = SQUARE
    reflector: Loss = SQUARE
    pose_prior: Loss = SQUARE
    landmark_prior: Loss = SQUARE
    range: Loss = SQUARE

    @cached_property
    def codes(self) -> Array:
        """(kind of loss, scale) by FactorKind (k, 2), as the kernels take them."""
        return np.array([(one.kind, one.scale) for one in self.in_order()])

    def in_order(self) -> tuple[Loss, ...]:
        """The losses by FactorKind."""
        return tuple(getattr(self, kind.name.lower()) for kind in FactorKind)


# --- formulas: of scalars in kernels, of arrays in NumPy

Number = Any
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]


class Information(NamedTuple):
    """Upper triangle of the information matrix W of a residual; zeros for an angle not there."""

    I00: Number
    I01: Number
    I02: Number
    I11: Number
    I12: Number
    I22: Number


@formula
def rotate(c: Number, s: Number, x: Number, y: Number) -> Pair:
    """R v of a vector (x, y)."""
    return c * x - s * y, s * x + c * y


@formula
def rotate_back(c: Number, s: Number, x: Number, y: Number) -> Pair:
    """R^T v of a vector (x, y)."""
    return c * x + s * y, c * y - s * x


@formula
def direction(dx: Number, dy: Number) -> Pair:
    """Cosine and sine of the direction of d; (1, 0) below MIN_DISTANCE."""
    length = np.sqrt(dx * dx + dy * dy)
    near = 1.0 * (length <= MIN_DISTANCE)
    return (dx + near) / (length + near), dy / (length + near)


@formula
def axes(kind: Number, c: Number, s: Number, dx: Number, dy: Number) -> Pair:
    """Cosine and sine of the axes R of a factor; ``c`` and ``s`` those of its pose."""
    if kind == RANGE:
        return direction(dx, dy)
    return c, s


@formula
def is_curved(kind: int) -> bool:
    """Whether the axes turn where nodes move, and not with the heading alone."""
    return kind == RANGE


@formula
def residual(c: Number, s: Number, dx: Number, dy: Number, x: Number, y: Number) -> Pair:
    """R^T d - z, the first two rows of e."""
    px, py = rotate_back(c, s, dx, dy)
    return px - x, py - y


@formula
def weighted(W: Information, e0: Number, e1: Number, e2: Number) -> Triple:
    """W e."""
    return (
        W.I00 * e0 + W.I01 * e1 + W.I02 * e2,
        W.I01 * e0 + W.I11 * e1 + W.I12 * e2,
        W.I02 * e0 + W.I12 * e1 + W.I22 * e2,
    )


@formula
def position_information(W: Information, w: Number, c: Number, s: Number) -> Triple:
    """M = w R W R^T of the position: M00, M01, M11."""
    t00, t01 = w * (W.I00 * c - W.I01 * s), w * (W.I00 * s + W.I01 * c)
    t10, t11 = w * (W.I01 * c - W.I11 * s), w * (W.I01 * s + W.I11 * c)
    return c * t00 - s * t10, c * t01 - s * t11, s * t01 + c * t11


@formula
def moment(dx: Number, dy: Number, fx: Number, fy: Number) -> Number:
    """D x f, what the heading of node i takes of a force on j: the third row of A^T (fx, fy)."""
    return dx * fy - dy * fx


@formula
def by_heading(c: Number, s: Number, dx: Number, dy: Number) -> Pair:
    """The last column of J_i: -R^T K d with K = [0 -1; 1 0]."""
    return rotate_back(c, s, dy, -dx)


@formula
def linear_change(
    c: Number, s: Number, d: Pair, step_i: Triple,
    step_j: Triple,
) -> Triple:  # fmt: skip
    """J_i step_i + J_j step_j."""
    x = step_j[0] - (step_i[0] - d[1] * step_i[2])
    y = step_j[1] - (step_i[1] + d[0] * step_i[2])
    px, py = rotate_back(c, s, x, y)
    return px, py, step_j[2] - step_i[2]


@formula
def model_error(turn: Pair, phi: Number, q: Pair, q0: Pair) -> Pair:
    """R'^T d' - (R^T d' - phi K R^T d): e' less its linear model, with K = [0 -1; 1 0].

    With ``turn`` cosine and sine of the angle from the axes R to R', ``phi`` the change of
    theta_i, q = R^T d' and q0 = R^T d.
    """
    px, py = rotate_back(turn[0], turn[1], q[0], q[1])
    return px - q[0] - phi * q0[1], py - q[1] + phi * q0[0]


@formula
def relaxed(kind: Number, I00: Number, I11: Number, x: Number, y: Number) -> Triple:
    """(Weight, z) of the linear residual t_j - t_i - R z: a mean, as R is not known yet."""
    if kind == RANGE:
        return LINEAR_SHARE * I00, 0.0, 0.0
    return 0.5 * (I00 + I11), x, y


# --- batched


def relative_pose(X_i: ArrayLike, X_j: ArrayLike, delta: ArrayLike) -> tuple[Array, Array, Array]:
    """E = chart(delta^-1 X_i^-1 X_j) ``(..., 3)``, J_i and J_j ``(..., 3, 3)``; delta = T_i_j."""
    X_i, X_j, delta = (np.asarray(a, dtype=np.float64) for a in (X_i, X_j, delta))
    theta, d = X_i[..., 2] + delta[..., 2], X_j[..., :2] - X_i[..., :2]
    c, s = np.cos(delta[..., 2]), np.sin(delta[..., 2])
    z = rotate_back(c, s, delta[..., 0], delta[..., 1])
    _, J_i, J_j = _evaluate(np.cos(theta), np.sin(theta), d, z, np.zeros_like(theta + d[..., 0]))
    # the same with R^T = R_delta^T R_i^T applied one after the other: closures that are decided by
    # a rounding, where two scores are equal, stay those of se2.between
    p = between(X_i, X_j)
    J_i[..., 0, 2], J_i[..., 1, 2] = by_heading(c, s, p[..., 0], p[..., 1])
    return between(delta, p), J_i, J_j


def pose_landmark(
    X: ArrayLike, m: ArrayLike, z: ArrayLike, kinds: ArrayLike = FactorKind.REFLECTOR
) -> tuple[Array, Array, Array]:
    """E = R^T (m - p) - z ``(..., 2)``, J_X ``(..., 2, 3)``, J_m ``(..., 2, 2)``.

    ``z`` is the (x, y) of the landmark seen from the pose, R = R(theta); or where ``kinds`` (...)
    is RANGE, (r, 0) in the axes of d = m - p. Eq. 2 writes z - R^T (m - p); the sign is
    chosen here so that all factors are predicted minus measured.
    """
    X, m, z = (np.asarray(a, dtype=np.float64) for a in (X, m, z))
    d = m - X[..., :2]
    by_range = np.equal(kinds, RANGE)
    heading = np.cos(X[..., 2]), np.sin(X[..., 2])
    c, s = (
        np.where(by_range, ours, theirs)
        for ours, theirs in zip(axes(RANGE, 1.0, 0.0, d[..., 0], d[..., 1]), heading, strict=True)
    )
    return _evaluate(c, s, d, (z[..., 0], z[..., 1]))


def range_only(X: ArrayLike, m: ArrayLike, r: ArrayLike) -> tuple[Array, Array, Array]:
    """E = |m - p| - r ``(..., 1)`` [m], J_X ``(..., 1, 3)``, J_m ``(..., 1, 2)``: a beacon heard.

    At m = p, where |d| has no derivative, the Jacobians are those of a beacon along the x axis.
    """
    r = np.asarray(r, dtype=np.float64)
    z = np.stack([r, np.zeros_like(r)], -1)
    e, J_X, J_m = pose_landmark(X, m, z, RANGE)
    return e[..., :1], J_X[..., :1, :], J_m[..., :1, :]


def pose_prior(X: ArrayLike, prior: ArrayLike) -> tuple[Array, Array]:
    """E = (p - p_0, theta - theta_0) ``(..., 3)`` in the axes of the map, J = identity."""
    e = np.asarray(X, dtype=np.float64) - np.asarray(prior, dtype=np.float64)
    e[..., 2] = wrap(e[..., 2])
    return e, np.broadcast_to(np.eye(3), (*e.shape, 3)).copy()


def landmark_prior(m: ArrayLike, prior: ArrayLike) -> tuple[Array, Array]:
    """E = m - m_0 ``(..., 2)`` (a surveyed reflector), J = identity."""
    e = np.asarray(m, dtype=np.float64) - np.asarray(prior, dtype=np.float64)
    return e, np.broadcast_to(np.eye(2), (*e.shape, 2)).copy()


def _evaluate(
    c: Array, s: Array, d: Array, z: tuple[Array, Array], angle: Array | None = None
) -> tuple[Array, Array, Array]:
    """(e, J_i, J_j) of factors with axes (c, s): of poses with an ``angle``, else of landmarks."""
    dx, dy = d[..., 0], d[..., 1]
    size = 2 if angle is None else 3
    rows = residual(c, s, dx, dy, *z)
    e = np.stack(np.broadcast_arrays(*(rows if angle is None else (*rows, angle))), -1)
    J_j = np.zeros((*e.shape, size))
    for k, unit in enumerate(((1.0, 0.0), (0.0, 1.0))):
        J_j[..., 0, k], J_j[..., 1, k] = rotate_back(c, s, *unit)
    J_i = np.zeros((*e.shape, 3))
    J_i[..., :, :2] = -J_j[..., :, :2]
    J_i[..., 0, 2], J_i[..., 1, 2] = by_heading(c, s, dx, dy)
    if angle is not None:
        J_j[..., 2, 2], J_i[..., 2, 2] = 1.0, -1.0
    return e, J_i, J_j


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
