# SPDX-License-Identifier: Apache-2.0
"""A world to drive in: surfaces as arrays for ray casting, reflectors, things that move, a route.

All coordinates are in the world frame. What one beam can hit is an *object*: first all segments,
then all discs, in the order of their arrays; ``surface`` has one row per object.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array

# columns of the surface table
REFLECTANCE, GLOSS, RETRO, REFLECTOR = range(4)
NO_REFLECTOR = -1.0


@dataclass(frozen=True)
class Geometry:
    """What beams can hit.

    ``segments`` (s, 6): x0, y0, x1, y1, vx, vy; the front of a segment is on its left.
    ``discs`` (d, 5): x, y, radius, vx, vy. ``surface`` (s + d, 4): diffuse reflectance [0, 1],
    share of mirror-like reflection [0, 1], 1 for retro-reflective, index of the reflector or -1.
    Velocities [m/s] are those during one scan, zero for what stands.
    """

    segments: Array
    discs: Array
    surface: Array

    def joined(self, other: Geometry) -> Geometry:
        """Both, this one's segments and discs first."""
        s, t = len(self.segments), len(other.segments)
        return Geometry(
            np.concatenate([self.segments, other.segments]),
            np.concatenate([self.discs, other.discs]),
            np.concatenate(
                [self.surface[:s], other.surface[:t], self.surface[s:], other.surface[t:]]
            ),
        )


NOTHING = Geometry(np.zeros((0, 6)), np.zeros((0, 5)), np.zeros((0, 4)))


@dataclass(frozen=True)
class ReflectorSet:
    """Cylinders and flat reflectors.

    ``points`` (m, 2): centre of a cylinder or middle of a flat one's face; ``widths`` (m,) [m]:
    diameter or width; ``normals`` (m,) [rad] of flat ones, NaN for cylinders; ``ids`` (m,).
    """

    points: Array
    widths: Array
    normals: Array
    ids: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.points)

    def geometry(self) -> Geometry:
        """The reflectors as retro-reflective discs and segments."""
        flat = ~np.isnan(self.normals)
        n = self.normals[flat]
        # left of a -> b is the normal: the direction is the normal turned by -90 degrees
        half = 0.5 * self.widths[flat, None] * np.stack([np.sin(n), -np.cos(n)], -1)
        p = self.points[flat]
        segments = np.concatenate([p - half, p + half, np.zeros_like(p)], -1)
        q = self.points[~flat]
        discs = np.concatenate([q, 0.5 * self.widths[~flat, None], np.zeros_like(q)], -1)
        index = np.concatenate([np.flatnonzero(flat), np.flatnonzero(~flat)]).astype(np.float64)
        surface = np.zeros((len(index), 4))
        surface[:, REFLECTANCE], surface[:, RETRO], surface[:, REFLECTOR] = 0.5, 1.0, index
        return Geometry(segments, discs, surface)


@dataclass(frozen=True)
class Mover:
    """A disc (``size`` = diameter twice) or box (length, width) on a closed loop of ``route``.

    ``route`` (k, 2) waypoints, the last one leading back to the first; ``start`` [m] is the
    distance along it at time 0. A box turns with its route.
    """

    shape: str
    size: tuple[float, float]
    route: Array
    speed: float
    start: float
    reflectance: float

    def pose_at(self, time: float) -> tuple[Array, Array]:
        """Pose (3,) and velocity (2,) at ``time`` [s] since the start of the simulation."""
        legs = np.roll(self.route, -1, axis=0) - self.route
        lengths = np.hypot(legs[:, 0], legs[:, 1])
        ends = np.cumsum(lengths)
        s = (self.start + self.speed * time) % ends[-1]
        k = int(np.searchsorted(ends, s, side='right')) % len(ends)
        direction = legs[k] / lengths[k]
        p = self.route[k] + direction * (s - (ends[k] - lengths[k]))
        heading = np.arctan2(direction[1], direction[0])
        return np.array([p[0], p[1], heading]), direction * self.speed

    def geometry(self, time: float) -> Geometry:
        """The mover where it is at ``time``, with its velocity."""
        pose, velocity = self.pose_at(time)
        surface = np.array([self.reflectance, 0.0, 0.0, NO_REFLECTOR])
        if self.shape == 'disc':
            disc = np.array([[pose[0], pose[1], 0.5 * self.size[0], *velocity]])
            return Geometry(np.zeros((0, 6)), disc, surface[None])
        a = box_corners(pose, self.size)
        moving = np.broadcast_to(velocity, (4, 2))
        segments = np.concatenate([a, np.roll(a, -1, axis=0), moving], -1)
        return Geometry(segments, np.zeros((0, 5)), np.tile(surface, (4, 1)))


@dataclass(frozen=True)
class World:
    """A world file, ready to use. ``start`` (3,) and ``route`` (k, 2) are the robot's."""

    name: str
    description: str
    static: Geometry
    reflectors: ReflectorSet
    movers: tuple[Mover, ...]
    start: Array
    route: Array

    def geometry(self, time: float) -> Geometry:
        """All that can be hit at ``time`` [s] since the start of the simulation."""
        whole = self.static.joined(self.reflectors.geometry())
        for mover in self.movers:
            whole = whole.joined(mover.geometry(time))
        return whole

    def without_reflectors(self) -> World:
        """The same world with no reflector in it."""
        none = ReflectorSet(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
        return dataclasses.replace(self, reflectors=none)

    def without_movers(self) -> World:
        """The same world with nothing moving in it."""
        return dataclasses.replace(self, movers=())


def box_corners(pose: Array, size: tuple[float, float]) -> Array:
    """Corners (4, 2) of a box, clockwise, so that its outside is on the left of each side."""
    x, y, theta = pose
    local = 0.5 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) * np.array(size)
    c, s = np.cos(theta), np.sin(theta)
    corners: Array = np.array([x, y]) + local @ np.array([[c, s], [-s, c]])
    return corners
