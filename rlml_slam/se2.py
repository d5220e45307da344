# SPDX-License-Identifier: Apache-2.0
"""SE(2) on arrays of poses ``(..., 3)`` = (x [m], y [m], theta [rad]), theta in (-pi, pi].

``T_a_b`` is the pose of frame b in frame a, so ``T_a_c = compose(T_a_b, T_b_c)``. Every function
broadcasts over leading dimensions, takes any real array and returns float64.

Single poses, which a robot has one of at a time, go through plain floats: NumPy takes ten times
as long for three numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam.compiled import brief, formula

Array = NDArray[np.float64]


@formula
def wrapped(angle: float) -> float:
    """One angle [rad] moved to (-pi, pi], as :func:`wrap`; for kernels too."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@formula
def wrapped_by_turns(angle: float) -> float:
    """As :func:`wrapped`; an angle within (-pi, pi] keeps its bits, and there is no division.

    For the inner loops of the solvers.
    """
    turns: float = np.ceil((angle - math.pi) / (2.0 * math.pi))
    return angle - 2.0 * math.pi * turns


def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine, NaN of what is not finite."""
    if not math.isfinite(angle):
        return math.nan, math.nan
    return math.cos(angle), math.sin(angle)


def _arc(w: float) -> tuple[float, float]:
    """(sin(w) / w, (1 - cos(w)) / w) without a division by a small w."""
    c, s = cos_sin(0.5 * w)
    half = s / (0.5 * w) if abs(w) > 1e-9 else 1.0
    return half * c, half * s


def wrap(angle: ArrayLike) -> Array:
    """Angle [rad] moved to (-pi, pi]; NaN and Inf become NaN."""
    with np.errstate(invalid='ignore'):
        return np.pi - np.mod(np.pi - np.asarray(angle, dtype=np.float64), 2.0 * np.pi)


def rotation(theta: ArrayLike) -> Array:
    """R(theta) ``(..., 2, 2)``, which rotates body coordinates into the parent frame."""
    theta = np.asarray(theta, dtype=np.float64)
    if theta.ndim == 0:
        cos, sin = cos_sin(float(theta))
        return np.array([[cos, -sin], [sin, cos]])
    R = np.empty((*theta.shape, 2, 2))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(theta)
    R[..., 1, 0] = np.sin(theta)
    R[..., 0, 1] = -R[..., 1, 0]
    return R


def rotation3(theta: float) -> Array:
    """R(theta) (3, 3) on poses and twists: rotates (x, y), keeps the heading."""
    R = np.eye(3)
    R[:2, :2] = rotation(theta)
    return R


def rotate_cov(cov: Array, theta: float) -> Array:
    """R cov R^T of a pose (3, 3): ``cov`` is in axes rotated by ``theta`` in the parent frame."""
    R = rotation3(theta)
    out: Array = R @ cov @ R.T
    return out


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """T_a_c = T_a_b T_b_c."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        (x, y, turn), (u, v, w) = a.tolist(), b.tolist()
        cos, sin = cos_sin(turn)
        return np.array([x + cos * u - sin * v, y + sin * u + cos * v, wrapped(turn + w)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    out[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    out[..., 2] = wrap(a[..., 2] + b[..., 2])
    return out


@brief
def compose_belief(T_a_b: Array, T_b_c: Array, cov: Array) -> tuple[Array, Array]:
    """One T_a_c (3,), with the covariance (3, 3) of T_b_c turned from b's axes to a's."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    x, y, turn = T_b_c[0], T_b_c[1], T_a_b[2] + T_b_c[2]
    pose = np.array([T_a_b[0] + c * x - s * y, T_a_b[1] + s * x + c * y, wrapped(turn)])
    out = cov.copy()
    for k in range(3):
        u, v = out[0, k], out[1, k]
        out[0, k], out[1, k] = c * u - s * v, s * u + c * v
    for k in range(3):
        u, v = out[k, 0], out[k, 1]
        out[k, 0], out[k, 1] = c * u - s * v, s * u + c * v
    return pose, out


def inverse(T_a_b: ArrayLike) -> Array:
    """T_b_a = T_a_b^-1."""
    a = np.asarray(T_a_b, dtype=np.float64)
    if a.ndim == 1:
        x, y, turn = a.tolist()
        cos, sin = cos_sin(turn)
        return np.array([-cos * x - sin * y, sin * x - cos * y, wrapped(-turn)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap(-a[..., 2])], -1
    )


def between(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Array:
    """T_b_c = T_a_b^-1 T_a_c, the pose of c seen from b."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_a_c, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        (x, y, turn), (u, v, w) = a.tolist(), b.tolist()
        cos, sin = cos_sin(turn)
        u, v = u - x, v - y
        return np.array([cos * u + sin * v, cos * v - sin * u, wrapped(w - turn)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = c * dx + s * dy
    out[..., 1] = c * dy - s * dx
    out[..., 2] = wrap(b[..., 2] - a[..., 2])
    return out


def transform(T_a_b: ArrayLike, p_b: ArrayLike) -> Array:
    """Points ``(..., n, 2)`` of frame b, by poses ``(..., 3)``, in frame a."""
    a, p = np.asarray(T_a_b, dtype=np.float64), np.asarray(p_b, dtype=np.float64)
    if a.ndim == 1 and p.ndim == 2:
        x, y, turn = a.tolist()
        return _moved(x, y, turn, np.ascontiguousarray(p))
    c, s = np.cos(a[..., 2])[..., None], np.sin(a[..., 2])[..., None]
    x = a[..., 0, None] + c * p[..., 0] - s * p[..., 1]
    out = np.empty((*x.shape, 2))
    out[..., 0] = x
    out[..., 1] = a[..., 1, None] + s * p[..., 0] + c * p[..., 1]
    return out


@brief
def _moved(x: float, y: float, turn: float, points: Array) -> Array:
    """Points (n, 2) of the frame at (x, y, turn), in its parent frame."""
    c, s = math.cos(turn), math.sin(turn)
    out = np.empty((len(points), 2))
    for k in range(len(points)):
        out[k, 0] = x + c * points[k, 0] - s * points[k, 1]
        out[k, 1] = y + s * points[k, 0] + c * points[k, 1]
    return out


def compose_jacobians(T_a_b: ArrayLike, T_b_c: ArrayLike) -> tuple[Array, Array]:
    """D compose / d T_a_b and d compose / d T_b_c, each ``(..., 3, 3)``, in raw coordinates."""
    if np.ndim(T_a_b) == np.ndim(T_b_c) == 1:
        turn, (u, v, _) = float(np.asarray(T_a_b)[2]), np.asarray(T_b_c, np.float64).tolist()
        cos, sin = cos_sin(turn)
        return (
            np.array(
                [[1.0, 0.0, -sin * u - cos * v], [0.0, 1.0, cos * u - sin * v], [0.0, 0.0, 1.0]]
            ),
            np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]),
        )
    a, b = np.broadcast_arrays(np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, np.float64))
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    J_a = np.zeros((*a.shape, 3))
    J_a[..., 0, 0] = J_a[..., 1, 1] = J_a[..., 2, 2] = 1.0
    J_a[..., 0, 2] = -s * b[..., 0] - c * b[..., 1]
    J_a[..., 1, 2] = c * b[..., 0] - s * b[..., 1]
    J_b = np.zeros_like(J_a)
    J_b[..., 0, 0] = J_b[..., 1, 1] = c
    J_b[..., 0, 1], J_b[..., 1, 0] = -s, s
    J_b[..., 2, 2] = 1.0
    return J_a, J_b


def between_jacobians(T_a_b: ArrayLike, T_a_c: ArrayLike) -> tuple[Array, Array]:
    """D between / d T_a_b and d between / d T_a_c, each ``(..., 3, 3)``, in raw coordinates."""
    if np.ndim(T_a_b) == np.ndim(T_a_c) == 1:
        x, y, turn = np.asarray(T_a_b, np.float64).tolist()
        u, v, _ = np.asarray(T_a_c, np.float64).tolist()
        cos, sin = cos_sin(turn)
        u, v = u - x, v - y
        return (
            np.array(
                [
                    [-cos, -sin, cos * v - sin * u],
                    [sin, -cos, -cos * u - sin * v],
                    [0.0, 0.0, -1.0],
                ]
            ),
            np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]),
        )
    a, b = np.broadcast_arrays(np.asarray(T_a_b, dtype=np.float64), np.asarray(T_a_c, np.float64))
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    J_b = np.zeros((*a.shape, 3))
    J_b[..., 0, 0] = J_b[..., 1, 1] = c
    J_b[..., 0, 1], J_b[..., 1, 0] = s, -s
    J_b[..., 2, 2] = 1.0
    J_a = -J_b
    J_a[..., 0, 2] = -s * dx + c * dy
    J_a[..., 1, 2] = -c * dx - s * dy
    return J_a, J_b


def exp(tangent: ArrayLike) -> Array:
    """Pose reached by the constant body twist ``(..., 3)`` = (vx, vy, omega) in unit time."""
    t = np.asarray(tangent, dtype=np.float64)
    if t.ndim == 1:
        x, y, turn = t.tolist()
        straight, aside = _arc(turn)
        return np.array([straight * x - aside * y, aside * x + straight * y, wrapped(turn)])
    w = t[..., 2]
    # sin(w)/w and (1 - cos w)/w without a division by a small w: both through sinc
    a = np.sinc(w / np.pi)
    b = np.sinc(w / (2.0 * np.pi)) * np.sin(w / 2.0)
    return np.stack([a * t[..., 0] - b * t[..., 1], b * t[..., 0] + a * t[..., 1], wrap(w)], -1)


def log(T: ArrayLike) -> Array:
    """Body twist whose exp is T; inverse of exp for |omega| <= pi."""
    p = np.asarray(T, dtype=np.float64)
    if p.ndim == 1:
        x, y, turn = p.tolist()
        straight, aside = _arc(turn)
        short = 1.0 / (straight * straight + aside * aside)
        return np.array(
            [(straight * x + aside * y) * short, (straight * y - aside * x) * short, turn]
        )
    w = p[..., 2]
    a = np.sinc(w / np.pi)
    b = np.sinc(w / (2.0 * np.pi)) * np.sin(w / 2.0)
    scale = 1.0 / (a * a + b * b)
    return np.stack(
        [(a * p[..., 0] + b * p[..., 1]) * scale, (a * p[..., 1] - b * p[..., 0]) * scale, w], -1
    )


def adjoint(T: ArrayLike) -> Array:
    """Ad(T) ``(..., 3, 3)``: body twists of b expressed in a, ``T exp(t) = exp(Ad t) T``."""
    p = np.asarray(T, dtype=np.float64)
    c, s = np.cos(p[..., 2]), np.sin(p[..., 2])
    A = np.zeros((*p.shape, 3))
    A[..., 0, 0] = A[..., 1, 1] = c
    A[..., 0, 1], A[..., 1, 0] = -s, s
    A[..., 0, 2], A[..., 1, 2] = p[..., 1], -p[..., 0]
    A[..., 2, 2] = 1.0
    return A


def interpolate(T_a_b: ArrayLike, T_a_c: ArrayLike, fraction: ArrayLike) -> Array:
    """Pose at fraction (0 at b, 1 at c) along the constant twist from b to c."""
    step = log(between(T_a_b, T_a_c))
    return compose(T_a_b, exp(step * np.asarray(fraction, dtype=np.float64)[..., None]))


def align(points: Array, targets: Array) -> Array:
    """Pose (3,) T that minimises sum |T points_k - targets_k|^2; both (n, 2), in closed form.

    theta = atan2(sum p x q, sum p . q) over the centred points (Horn/Umeyama in the plane).
    """
    p_mean, q_mean = points.mean(axis=0), targets.mean(axis=0)
    p, q = points - p_mean, targets - q_mean
    cross = float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())
    theta = math.atan2(cross, float((p * q).sum()))
    shift = q_mean - rotation(theta) @ p_mean
    return np.array([shift[0], shift[1], theta])


def warm_up() -> None:
    """Compile the kernels."""
    transform(np.zeros(3), np.zeros((1, 2)))
    compose_belief(np.zeros(3), np.zeros(3), np.eye(3))
