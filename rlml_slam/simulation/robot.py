# SPDX-License-Identifier: Apache-2.0
"""The robot: a differential drive of bounded acceleration, its steering, and its true track."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.params import Simulator
from rlml_slam.se2 import Array

SECOND = 1_000_000_000
Command = tuple[float, float]
# what a steering function is asked: pose (x, y, theta) and the present speed
Steering = Callable[[float, float, float, float], Command]


class RouteFollower:
    """Pure pursuit of a polyline: an arc through the point ``lookahead`` ahead on the route."""

    def __init__(self, route: Array, limits: Simulator) -> None:
        self._points = route
        self._legs = np.diff(route, axis=0)
        self._lengths = np.hypot(self._legs[:, 0], self._legs[:, 1])
        self._ends = np.concatenate([[0.0], np.cumsum(self._lengths)])
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

    def point(self, distance: float) -> tuple[float, float]:
        """Point at a distance along the route; beyond its end, on the last leg produced."""
        if not len(self._legs):
            return float(self._points[0, 0]), float(self._points[0, 1])
        k = int(np.searchsorted(self._ends, distance, side='right')) - 1
        k = min(max(k, 0), len(self._legs) - 1)
        f = (distance - self._ends[k]) / self._lengths[k]
        p = self._points[k] + f * self._legs[k]
        return float(p[0]), float(p[1])

    def _advance(self, x: float, y: float) -> None:
        """Move progress to the nearest point of the route that is not far ahead.

        Only a window ahead counts, so that a route may cross itself and come back.
        """
        best = math.inf
        end = self._progress + 2.0 * self._limits.lookahead
        first = max(int(np.searchsorted(self._ends, self._progress, side='right')) - 1, 0)
        progress = self._progress
        for k in range(first, len(self._legs)):
            if self._ends[k] > end:
                break
            (ax, ay), (ex, ey), n = self._points[k], self._legs[k], self._lengths[k]
            s = self._ends[k] + ((x - ax) * ex + (y - ay) * ey) / n
            s = min(max(s, self._ends[k], self._progress), self._ends[k + 1], end)
            px, py = self.point(s)
            distance = math.hypot(px - x, py - y)
            if distance < best:
                best, progress = distance, float(s)
        self._progress = progress

    def steer(self, x: float, y: float, theta: float, speed: float) -> Command:
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


class Track:
    """The true motion: poses at knots, and between them exact arcs of constant twist.

    At least the last 300 s are kept. Headings are not wrapped inside.
    """

    CAPACITY = 65536

    def __init__(self, stamp: int, pose: Array) -> None:
        self._t = np.zeros(self.CAPACITY, np.int64)
        # x, y, theta of the knot; vx, vy, omega from it on; wheel travel so far
        self._k = np.zeros((self.CAPACITY, 7))
        self._n = 1
        self._t[0] = stamp
        self._k[0, :3] = pose

    @property
    def stamp(self) -> int:
        """Stamp of the newest knot."""
        return int(self._t[self._n - 1])

    @property
    def pose(self) -> Array:
        """Pose (3,) of the newest knot."""
        return self._k[self._n - 1, :3]

    @property
    def twist(self) -> Array:
        """Body twist (3,) from the newest knot on."""
        return self._k[self._n - 1, 3:6]

    def set_twist(self, v: float, lateral: float, omega: float) -> None:
        """Choose the twist from the newest knot on."""
        self._k[self._n - 1, 3:6] = v, lateral, omega

    def advance(self, step: int) -> None:
        """Append a knot ``step`` [ns] later; the twist goes on."""
        if self._n == self.CAPACITY:
            half = self.CAPACITY // 2
            self._t[:half], self._k[:half] = self._t[half:], self._k[half:]
            self._n = half
        n, stamp = self._n, self.stamp + step
        self._k[n] = self._rows(np.array([stamp]))[0]
        self._t[n] = stamp
        self._n += 1

    def _rows(self, stamps: NDArray[np.int64]) -> Array:
        """All columns (n, 7) at the stamps; the newest twist holds beyond the newest knot."""
        k = np.searchsorted(self._t[: self._n], stamps, side='right') - 1
        if len(k) and k.min() < 0:
            raise InputError('the simulated track does not reach back that far')
        rows = self._k[k]
        dt = (stamps - self._t[k]) / SECOND
        d = rows[:, 3:6] * dt[:, None]
        a = np.sinc(d[:, 2] / np.pi)
        b = np.sinc(d[:, 2] / (2.0 * np.pi)) * np.sin(0.5 * d[:, 2])
        x, y = a * d[:, 0] - b * d[:, 1], b * d[:, 0] + a * d[:, 1]
        c, s = np.cos(rows[:, 2]), np.sin(rows[:, 2])
        rows[:, 0] += c * x - s * y
        rows[:, 1] += s * x + c * y
        rows[:, 2] += d[:, 2]
        rows[:, 6] += d[:, 0]
        return rows

    def poses(self, stamps: NDArray[np.int64]) -> Array:
        """Poses (n, 3) at stamps (n,), theta not wrapped."""
        return self._rows(stamps)[:, :3]

    def pose_at(self, stamp: int) -> Array:
        """Pose (3,) at a stamp, theta wrapped."""
        pose = self._rows(np.array([stamp]))[0, :3]
        pose[2] = se2.wrap(pose[2])
        return pose

    def twist_at(self, stamp: int) -> Array:
        """Body twist (3,) at a stamp; at a knot, that from it on."""
        return self._rows(np.array([stamp]))[0, 3:6]

    def wheel_motion(self, start: int, end: int) -> tuple[float, float]:
        """Forward travel [m] and turn [rad] between two stamps, as perfect wheels measure them."""
        a, b = self._rows(np.array([start, end]))
        return float(b[6] - a[6]), float(b[2] - a[2])

    def turn_rate(self, stamp: int, window: int) -> float:
        """Mean turn rate [rad/s] over ``window`` [ns] around the stamp.

        Centred, so that the trapezoids through its samples add up to the turn made.
        """
        half = window // 2
        start = max(stamp - half, int(self._t[0]))
        a, b = self._rows(np.array([start, stamp + half]))
        return float(b[2] - a[2]) * SECOND / (stamp + half - start)
