# SPDX-License-Identifier: Apache-2.0
"""The robot: a differential drive of bounded acceleration, its steering, and its true track."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import kernel
from rlml_slam.errors import InputError
from rlml_slam.params import Simulator
from rlml_slam.se2 import Array

SECOND = 1_000_000_000
Command = tuple[float, float]


def there_and_back(route: Array) -> Array:
    """A route (n, 2) that ends where it begins: one that does not is driven back as well."""
    is_closed = math.dist(route[0], route[-1]) < 0.1
    return route if is_closed else np.vstack([route, route[-2::-1]])


class RouteFollower:
    """Pure pursuit of a polyline: an arc through the point ``lookahead`` ahead on the route."""

    def __init__(self, route: Array, limits: Simulator) -> None:
        legs = np.diff(route, axis=0)
        lengths = np.hypot(legs[:, 0], legs[:, 1])
        # plain floats: this runs a hundred times per simulated second
        self._points = route.tolist()
        self._directions = (legs / lengths[:, None]).tolist()
        self._ends = [0.0, *np.cumsum(lengths).tolist()]
        self._limits = limits
        self._progress = 0.0

    @property
    def length(self) -> float:
        """Length of the route [m]."""
        return float(self._ends[-1])

    @property
    def remaining(self) -> float:
        """What is left of it [m]."""
        return self.length - self._progress

    def restart(self) -> None:
        """Begin the route again."""
        self._progress = 0.0

    def skip(self, distance: float) -> tuple[float, float, float]:
        """Go on from ``distance`` [m] farther along the route, or back; the pose there."""
        self._progress = min(max(self._progress + distance, 0.0), self.length)
        dx, dy = self._directions[self._leg(self._progress)]
        return *self.point(self._progress), math.atan2(dy, dx)

    def _leg(self, distance: float) -> int:
        """Index of the leg at a distance along the route."""
        k = bisect_right(self._ends, distance) - 1
        return max(min(k, len(self._directions) - 1), 0)

    def point(self, distance: float) -> tuple[float, float]:
        """Point at a distance along the route; beyond its end, on the last leg produced."""
        if not self._directions:
            return self._points[0][0], self._points[0][1]
        k = self._leg(distance)
        (x, y), (dx, dy), s = self._points[k], self._directions[k], distance - self._ends[k]
        return x + s * dx, y + s * dy

    def _advance(self, x: float, y: float) -> None:
        """Move progress to the nearest point of the route that is not far ahead.

        Only a window ahead counts, so that a route may cross itself and come back.
        """
        best = math.inf
        end = self._progress + 2.0 * self._limits.lookahead
        progress = self._progress
        for k in range(self._leg(progress), len(self._directions)):
            if self._ends[k] > end:
                break
            (ax, ay), (dx, dy) = self._points[k], self._directions[k]
            s = self._ends[k] + (x - ax) * dx + (y - ay) * dy
            s = min(max(s, self._ends[k], self._progress), self._ends[k + 1], end)
            px, py = self.point(s)
            distance = math.hypot(px - x, py - y)
            if distance < best:
                best, progress = distance, s
        self._progress = progress

    def steer(self, x: float, y: float, theta: float) -> Command:
        """Wanted speed and turn rate; (0, 0) at the end of the route."""
        n = self._limits
        self._advance(x, y)
        left = self.remaining
        if left < 0.02:
            return 0.0, 0.0
        tx, ty = self.point(self._progress + n.lookahead)
        dx, dy = tx - x, ty - y
        c, s = math.cos(theta), math.sin(theta)
        ahead, aside = c * dx + s * dy, -s * dx + c * dy
        bearing = math.atan2(aside, ahead)
        if abs(bearing) > 1.2:  # too far round for an arc: turn on the spot
            return 0.0, math.copysign(min(n.turn_rate, 2.0 * abs(bearing)), bearing)
        curvature = 2.0 * aside / (dx * dx + dy * dy)
        v = min(n.speed, 0.9 * math.sqrt(2.0 * n.acceleration * left) + 0.01)
        if abs(curvature) > 1e-9:
            v = min(v, n.turn_rate / abs(curvature))
        return v, v * curvature


def approach(now: float, wanted: float, most: float) -> float:
    """``wanted``, or as far from ``now`` towards it as ``most`` allows."""
    return now + min(max(wanted - now, -most), most)


@kernel
def _along(knots: Array, count: int, first: int, step: int, stamps: NDArray[np.int64]) -> Array:
    """Columns of the track (n, 8) at stamps not before ``first``, by exact arcs from the knots."""
    out = np.empty((len(stamps), 8))
    for i in range(len(stamps)):
        k = min((stamps[i] - first) // step, count - 1)
        row = knots[k]
        dt = (stamps[i] - first - k * step) * 1e-9
        # exp of the twist: chord of half the turn, without a division by a small turn
        half = 0.5 * row[5] * dt
        sinc = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        c, s = math.cos(row[2] + half) * sinc * dt, math.sin(row[2] + half) * sinc * dt
        out[i, 0] = row[0] + c * row[3] - s * row[4]
        out[i, 1] = row[1] + s * row[3] + c * row[4]
        out[i, 2] = row[2] + row[5] * dt
        out[i, 3:6] = row[3:6]
        out[i, 6] = row[6] + row[3] * dt
        out[i, 7] = row[7] + row[5] * dt
    return out


class Track:
    """The true motion: poses at knots, one per step, and between them arcs of constant twist.

    At least the last 300 s of 10 ms steps are kept. Headings are not wrapped inside.
    """

    CAPACITY = 65536

    def __init__(self, stamp: int, pose: Array, step: int = 10_000_000) -> None:
        self._first = stamp
        self._step = step
        # x, y, theta of the knot; vx, vy, omega from it on; travel and turn so far of the wheels
        self._knots = np.zeros((self.CAPACITY, 8))
        self._count = 1
        self._knots[0, :3] = pose
        self._knots[0, 7] = pose[2]

    @property
    def stamp(self) -> int:
        """Stamp of the newest knot."""
        return self._first + (self._count - 1) * self._step

    @property
    def pose(self) -> tuple[float, float, float]:
        """Pose of the newest knot, theta not wrapped."""
        x, y, theta = self._knots[self._count - 1, :3].tolist()
        return x, y, theta

    @property
    def twist(self) -> tuple[float, float, float]:
        """Body twist from the newest knot on."""
        v, lateral, omega = self._knots[self._count - 1, 3:6].tolist()
        return v, lateral, omega

    def set_twist(self, v: float, lateral: float, omega: float) -> None:
        """Choose the twist from the newest knot on."""
        self._knots[self._count - 1, 3:6] = v, lateral, omega

    def carry(self, pose: Array) -> None:
        """Put the robot elsewhere (3,) at the newest knot; wheels and gyro feel nothing."""
        self._knots[self._count - 1, :3] = pose

    def advance(self) -> None:
        """Append the next knot; the twist goes on."""
        row = self._rows(self.stamp + self._step)[0]
        if self._count == self.CAPACITY:
            half = self.CAPACITY // 2
            self._knots[:half] = self._knots[half:]
            self._first += half * self._step
            self._count = half
        self._knots[self._count] = row
        self._count += 1

    def _rows(self, *stamps: int) -> Array:
        return self._columns(np.array(stamps, dtype=np.int64))

    def _columns(self, stamps: NDArray[np.int64]) -> Array:
        """All columns (n, 8) at the stamps; the newest twist holds beyond the newest knot."""
        if len(stamps) and np.min(stamps) < self._first:
            raise InputError('the simulated track does not reach back that far')
        return _along(self._knots, self._count, self._first, self._step, stamps)

    def poses(self, stamps: NDArray[np.int64]) -> Array:
        """Poses (n, 3) at stamps (n,), theta not wrapped."""
        return self._columns(stamps)[:, :3]

    def pose_at(self, stamp: int) -> Array:
        """Pose (3,) at a stamp, theta wrapped."""
        pose = self._rows(stamp)[0, :3]
        pose[2] = se2.wrap(pose[2])
        return pose

    def twist_at(self, stamp: int) -> Array:
        """Body twist (3,) at a stamp; at a knot, that from it on."""
        return self._rows(stamp)[0, 3:6]

    def wheel_motion(self, start: int, end: int) -> tuple[float, float]:
        """Forward travel [m] and turn [rad] between two stamps, as perfect wheels measure them."""
        a, b = self._rows(start, end)
        return float(b[6] - a[6]), float(b[7] - a[7])

    def turn_rate(self, stamp: int) -> float:
        """Mean turn rate [rad/s] over one step around the stamp.

        Centred, so that the trapezoids through its samples add up to the turn made.
        """
        start, end = max(stamp - self._step // 2, self._first), stamp + self._step // 2
        a, b = self._rows(start, end)
        return float(b[7] - a[7]) * SECOND / (end - start)


def warm_up() -> None:
    """Compile the kernel."""
    Track(0, np.zeros(3)).pose_at(0)
