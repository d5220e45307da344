# SPDX-License-Identifier: Apache-2.0
"""What a beam meets first: compiled ray casting against segments and discs, all in motion.

Every segment and disc is tried only against the rays that can reach it: those inside the angle
that it spans as seen from the middle ray's origin, widened by how far origins and objects move
and by how far the rays' angles are from evenly spaced. Where that angle is unbounded, all rays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array, wrapped_by_turns
from rlml_slam.simulation.world import NOTHING, Geometry

NO_OBJECT = -1


class Shape(NamedTuple):
    """A segment from (x, y) by (ex, ey), or a disc of a ``radius``, which segments have not."""

    x: float
    y: float
    ex: float
    ey: float
    vx: float
    vy: float
    radius: float


@kernel
def _cast(
    x: Array, y: Array, angles: Array, tau: Array, segments: Array, discs: Array, max_range: float
) -> tuple[Array, NDArray[np.int64], Array]:
    n = len(angles)
    ranges = np.full(n, np.inf)
    objects = np.full(n, -1, np.int64)
    cosines = np.zeros(n)
    if n == 0:
        return ranges, objects, cosines
    c, s = np.cos(angles), np.sin(angles)
    step = (angles[n - 1] - angles[0]) / (n - 1) if n > 1 else 0.0
    mx, my = x[n // 2], y[n // 2]
    reach, uneven, span = 0.0, 0.0, 0.0
    for k in range(n):
        reach = max(reach, math.hypot(x[k] - mx, y[k] - my))
        uneven = max(uneven, abs(angles[k] - angles[0] - k * step))
        span = max(span, abs(tau[k]))
    best = np.full(n, max_range)
    for j in range(len(segments) + len(discs)):
        shape = _shape(segments, discs, j)
        distance, centre, half = _window(shape, mx, my)
        moved = reach + span * math.hypot(shape.vx, shape.vy)
        if distance - moved > max_range:
            continue
        # beyond one and a half turns, the three windows below would not be all there are
        all_rays = not 0.0 < step * n < 3.0 * math.pi or distance <= moved + 1e-9
        if not all_rays:
            half += math.asin(moved / distance) + uneven + 1e-9
        offset = (centre - angles[0]) % (2.0 * math.pi)
        for window in range(1 if all_rays else 3):
            low, high = 0, n - 1
            if not all_rays:
                middle = offset + (window - 1) * 2.0 * math.pi
                low = math.ceil(max(0.0, (middle - half) / step))
                high = math.floor(min(n - 1.0, (middle + half) / step))
            for k in range(low, high + 1):
                # the object's own motion, seen as the opposite motion of the origin
                qx = shape.x + shape.vx * tau[k] - x[k]
                qy = shape.y + shape.vy * tau[k] - y[k]
                t, cosine = _meet(shape, qx, qy, c[k], s[k], best[k])
                if t < best[k]:
                    best[k] = ranges[k] = t
                    cosines[k], objects[k] = cosine, j
    return ranges, objects, cosines


@part
def _shape(segments: Array, discs: Array, j: int) -> Shape:
    """Object j, the discs after the segments."""
    if j < len(segments):
        g = segments[j]
        return Shape(g[0], g[1], g[2] - g[0], g[3] - g[1], g[4], g[5], -1.0)
    d = discs[j - len(segments)]
    return Shape(d[0], d[1], 0.0, 0.0, d[3], d[4], d[2])


@part
def _window(o: Shape, x: float, y: float) -> tuple[float, float, float]:
    """Distance of an object from a point; middle and half of the angle that it spans there."""
    px, py = o.x - x, o.y - y
    if o.radius < 0.0:
        # nearest point of the segment, then the angle it spans
        f = min(1.0, max(0.0, -(px * o.ex + py * o.ey) / (o.ex * o.ex + o.ey * o.ey)))
        first = math.atan2(py, px)
        half = 0.5 * wrapped_by_turns(math.atan2(py + o.ey, px + o.ex) - first)
        return math.hypot(px + f * o.ex, py + f * o.ey), first + half, abs(half)
    distance = math.hypot(px, py) - o.radius
    half = math.asin(o.radius / (distance + o.radius)) if distance > 0.0 else math.pi
    return distance, math.atan2(py, px), half


@part
def _meet(
    o: Shape, qx: float, qy: float, c: float, s: float, nearest: float
) -> tuple[float, float]:
    """Range at which a ray meets an object at (qx, qy) from its origin, infinite from ``nearest``.

    Then the cosine of the incidence.
    """
    if o.radius < 0.0:
        det = c * o.ey - s * o.ex
        if abs(det) < 1e-12:
            return math.inf, 0.0
        t = (qx * o.ey - qy * o.ex) / det
        if not 0.0 < t < nearest:
            return math.inf, 0.0
        u = (qx * s - qy * c) / det
        if u < -1e-12 or u > 1.0 + 1e-12:
            return math.inf, 0.0
        return t, det / math.sqrt(o.ex * o.ex + o.ey * o.ey)
    along = qx * c + qy * s
    across = qx * s - qy * c
    root = o.radius * o.radius - across * across
    if along <= 0.0 or root < 0.0:
        return math.inf, 0.0
    root = math.sqrt(root)
    t = along - root
    if not 0.0 < t < nearest:
        return math.inf, 0.0
    return t, root / o.radius


def cast(
    origins: Array, angles: Array, tau: Array, geometry: Geometry, max_range: float
) -> tuple[Array, NDArray[np.int64], Array]:
    """First hit of each ray: range [m], object, cosine of the angle to the surface's normal.

    ``origins`` (n, 2) and ``angles`` (n,) [rad] in the world frame; ``tau`` (n,) [s] is when each
    ray is cast, from the moment that ``geometry`` is of. Nothing within ``max_range``: Inf,
    NO_OBJECT and 0. The cosine of a segment hit from behind (its right) is negative. A ray that
    starts inside a disc does not see it. Evenly spaced angles are fast, any are right.
    """
    return _cast(
        np.ascontiguousarray(origins[:, 0]),
        np.ascontiguousarray(origins[:, 1]),
        np.ascontiguousarray(angles),
        np.ascontiguousarray(tau),
        geometry.segments,
        geometry.discs,
        max_range,
    )


def warm_up() -> None:
    """Compile the kernel."""
    cast(np.zeros((2, 2)), np.array([0.0, 1.0]), np.zeros(2), NOTHING, 1.0)
