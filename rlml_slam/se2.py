# SPDX-License-Identifier: Apache-2.0
"""SE(2) on arrays of poses ``(..., 3)`` = (x [m], y [m], theta [rad]), theta in (-pi, pi].

``T_a_b`` is the pose of frame b in frame a, so ``T_a_c = compose(T_a_b, T_b_c)``. Every function
broadcasts over leading dimensions, takes any real array and returns float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap(angle: ArrayLike) -> Array:
    """Angle [rad] moved to (-pi, pi]; NaN and Inf become NaN."""
    with np.errstate(invalid='ignore'):
        return np.pi - np.mod(np.pi - np.asarray(angle, dtype=np.float64), 2.0 * np.pi)


def rotation(theta: ArrayLike) -> Array:
    """R(theta) ``(..., 2, 2)``, which rotates body coordinates into the parent frame."""
    theta = np.asarray(theta, dtype=np.float64)
    R = np.empty((*theta.shape, 2, 2))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(theta)
    R[..., 1, 0] = np.sin(theta)
    R[..., 0, 1] = -R[..., 1, 0]
    return R


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """T_a_c = T_a_b T_b_c."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    out[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    out[..., 2] = wrap(a[..., 2] + b[..., 2])
    return out


def inverse(T_a_b: ArrayLike) -> Array:
    """T_b_a = T_a_b^-1."""
    a = np.asarray(T_a_b, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap(-a[..., 2])], -1
    )


def between(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Array:
    """T_b_c = T_a_b^-1 T_a_c, the pose of c seen from b."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_a_c, dtype=np.float64)
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
    c, s = np.cos(a[..., 2])[..., None], np.sin(a[..., 2])[..., None]
    x = a[..., 0, None] + c * p[..., 0] - s * p[..., 1]
    out = np.empty((*x.shape, 2))
    out[..., 0] = x
    out[..., 1] = a[..., 1, None] + s * p[..., 0] + c * p[..., 1]
    return out


def compose_jacobians(T_a_b: ArrayLike, T_b_c: ArrayLike) -> tuple[Array, Array]:
    """D compose / d T_a_b and d compose / d T_b_c, each ``(..., 3, 3)``, in raw coordinates."""
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
    w = t[..., 2]
    # sin(w)/w and (1 - cos w)/w without a division by a small w: both through sinc
    a = np.sinc(w / np.pi)
    b = np.sinc(w / (2.0 * np.pi)) * np.sin(w / 2.0)
    return np.stack([a * t[..., 0] - b * t[..., 1], b * t[..., 0] + a * t[..., 1], wrap(w)], -1)


def log(T: ArrayLike) -> Array:
    """Body twist whose exp is T; inverse of exp for |omega| <= pi."""
    p = np.asarray(T, dtype=np.float64)
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
