# SPDX-License-Identifier: Apache-2.0
"""What a beam meets first: compiled ray casting against segments and discs, all in motion.

Every segment and disc is tried only against the rays that can reach it: those inside the angle
that it spans as seen from the middle ray's origin, widened by how far origins and objects move
and by how far the rays' angles are from evenly spaced. Where that angle is unbounded, all rays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.se2 import Array
from rlml_slam.simulation.world import NOTHING, Geometry

NO_OBJECT = -1


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
        is_segment = j < len(segments)
        ax = ay = ex = ey = vx = vy = radius = 0.0
        if is_segment:
            ax, ay = segments[j, 0], segments[j, 1]
            ex, ey = segments[j, 2] - ax, segments[j, 3] - ay
            vx, vy = segments[j, 4], segments[j, 5]
            # nearest point of the segment to the middle origin, then the angle it spans
            px, py = ax - mx, ay - my
            f = min(1.0, max(0.0, -(px * ex + py * ey) / (ex * ex + ey * ey)))
            distance = math.hypot(px + f * ex, py + f * ey)
            first = math.atan2(py, px)
            turn = math.atan2(py + ey, px + ex) - first
            half = 0.5 * (turn - 2.0 * math.pi * round(turn / (2.0 * math.pi)))
            centre = first + half
            half = abs(half)
        else:
            d = discs[j - len(segments)]
            ax, ay, radius, vx, vy = d[0], d[1], d[2], d[3], d[4]
            distance = math.hypot(ax - mx, ay - my) - radius
            centre = math.atan2(ay - my, ax - mx)
            half = math.asin(radius / (distance + radius)) if distance > 0.0 else math.pi
        moved = reach + span * math.hypot(vx, vy)
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
                qx, qy = ax + vx * tau[k] - x[k], ay + vy * tau[k] - y[k]
                if is_segment:
                    det = c[k] * ey - s[k] * ex
                    if abs(det) < 1e-12:
                        continue
                    t = (qx * ey - qy * ex) / det
                    if not 0.0 < t < best[k]:
                        continue
                    u = (qx * s[k] - qy * c[k]) / det
                    if u < -1e-12 or u > 1.0 + 1e-12:
                        continue
                    cosines[k] = det / math.sqrt(ex * ex + ey * ey)
                else:
                    along = qx * c[k] + qy * s[k]
                    across = qx * s[k] - qy * c[k]
                    root = radius * radius - across * across
                    if along <= 0.0 or root < 0.0:
                        continue
                    root = math.sqrt(root)
                    t = along - root
                    if not 0.0 < t < best[k]:
                        continue
                    cosines[k] = root / radius
                best[k] = t
                ranges[k] = t
                objects[k] = j
    return ranges, objects, cosines


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
