# SPDX-License-Identifier: Apache-2.0
"""A large building by chance: corridors, rooms with furniture, halls with pillars; scans in it.

Rooms of one building look alike in many places, which is what makes a global search hard.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.se2 import Array
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.simulation.world import Geometry

CORRIDOR = 2.4  # [m] width
PITCH = 20.0  # [m] about, from corridor to corridor
DOOR = 0.95  # [m]
NICHE = 0.12  # [m] depth of a closed door
HALLS = 0.25  # share of the blocks between corridors
REACH = 30.0  # [m] of the laser
NOISE = 0.01  # [m] 1 sigma of a range
Walls = list[tuple[float, float, float, float]]


class Building:
    """Walls of a square building of ``size`` [m], and poses (n, 3) from which it is mapped."""

    def __init__(self, seed: int, size: float) -> None:
        self.rng = np.random.default_rng(seed)
        self._walls: Walls = _box(0.0, 0.0, size, size)
        self._places: list[tuple[float, float]] = []
        blocks = max(round(size / PITCH), 1)
        pitch = (size - CORRIDOR) / blocks
        for j in range(blocks):
            for i in range(blocks):
                x, y = j * pitch + CORRIDOR, i * pitch + CORRIDOR
                far = (x + pitch - CORRIDOR, y + pitch - CORRIDOR)
                make = self._hall if self.rng.random() < HALLS else self._rooms
                make(x, y, *far)
        for k in range(blocks + 1):
            for t in np.arange(1.0, size - 1.0):
                for axis in (1, -1):
                    middle = k * pitch + 0.5 * CORRIDOR + self.rng.uniform(-0.4, 0.4)
                    self._places.append((middle, t)[::axis])  # type: ignore[arg-type]
        walls = np.array(self._walls)
        self.geometry = Geometry(
            np.hstack([walls, np.zeros((len(walls), 2))]),
            np.zeros((0, 5)),
            np.zeros((len(walls), 4)),
        )
        heading = self.rng.uniform(-np.pi, np.pi, len(self._places))
        self.poses = np.column_stack([np.array(self._places), heading])

    def _hall(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Rows of pillars and boxes anywhere, open to two corridors."""
        rng = self.rng
        self._walls += [(x0, y0, x0, y1), (x1, y0, x1, y1), (x0, y0, x0 + 2.0, y0)]
        self._walls += [(x0 + 5.0, y0, x1, y0), (x0, y1, x1 - 6.0, y1), (x1 - 3.0, y1, x1, y1)]
        step = rng.uniform(3.5, 6.0)
        for x in np.arange(x0 + 2.0, x1 - 1.0, step):
            for y in np.arange(y0 + 2.0, y1 - 1.0, step):
                self._walls += _box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)
        for _ in range(25):
            x, y = rng.uniform((x0 + 1.0, y0 + 1.0), (x1 - 2.0, y1 - 2.0))
            w, h = rng.uniform(0.3, 1.5, 2)
            self._walls += _box(x, y, x + w, y + h)
        inside = rng.uniform((x0 + 0.7, y0 + 0.7), (x1 - 0.7, y1 - 0.7), (40, 2))
        self._places += [(x, y) for x, y in inside]

    def _rooms(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Two rows of rooms, back to back, with doors to the corridors."""
        middle = 0.5 * (y0 + y1)
        self._walls += [(x0, middle, x1, middle), (x0, y0, x0, y1), (x1, y0, x1, y1)]
        for low, high, door in ((y0, middle, y0), (middle, y1, y1)):
            x = x0
            while x < x1 - 2.5:
                end = x + min(self.rng.uniform(2.5, 7.0), x1 - x)
                end = x1 if x1 - end < 2.5 else end
                self._room(x, low, end, high, door)
                x = end

    def _room(self, x0: float, y0: float, x1: float, y1: float, door: float) -> None:
        """A room with a door in the wall at y = ``door``, its leaf, and boxes."""
        rng = self.rng
        at, open_by = rng.uniform(x0 + 0.3, x1 - 1.3), rng.uniform(0.3, 1.4)
        leaf = DOOR * np.sin(open_by) * (1.0 if door == y0 else -1.0)
        self._walls += [(x0, door, at, door), (at + DOOR, door, x1, door), (x1, y0, x1, y1)]
        self._walls += [(at, door, at + DOOR * np.cos(open_by), door + leaf)]
        for _ in range(rng.integers(1, 6)):
            w, h = rng.uniform(0.3, 1.6, 2)
            x, y = rng.uniform(x0 + 0.1, max(x1 - w - 0.1, x0 + 0.2)), rng.uniform(y0, y1 - h)
            self._walls += _box(x, y, min(x + w, x1 - 0.05), y + h)
        inside = rng.uniform((x0 + 0.5, y0 + 0.5), (x1 - 0.5, y1 - 0.5), (5, 2))
        self._places += [(x, y) for x, y in inside]

    def scan(self, pose: Array, beams: int, view: float) -> Array:
        """End points (n, 2), base frame, of a sweep over ``view`` [rad] at a pose (3,)."""
        angles = np.linspace(-0.5 * view, 0.5 * view, beams)
        origins = np.tile(pose[:2], (beams, 1))
        ranges, _, _ = cast(origins, pose[2] + angles, np.zeros(beams), self.geometry, REACH)
        hit = np.isfinite(ranges)
        r, angles = ranges[hit] + NOISE * self.rng.standard_normal(hit.sum()), angles[hit]
        return np.stack([r * np.cos(angles), r * np.sin(angles)], -1)

    def grid(self) -> OccupancyGrid:
        """The map from all poses, by a laser that sees all around."""
        scans = [self.scan(pose, 720, 2.0 * np.pi) for pose in self.poses]
        return render(self.poses, scans, [np.zeros(2)] * len(scans))

    def visits(self, number: int) -> Array:
        """Poses (number, 3) of a robot near those from which it was mapped."""
        chosen = self.poses[self.rng.permutation(len(self.poses))[:number]]
        low, high = (-0.3, -0.3, -np.pi), (0.3, 0.3, np.pi)
        return chosen + self.rng.uniform(low, high, chosen.shape)


class ClosedBuilding(Building):
    """All doors are closed: corridors are bare, but for the niches of the doors."""

    def _hall(self, x0: float, y0: float, x1: float, y1: float) -> None:
        self._rooms(x0, y0, x1, y1)

    def _rooms(self, x0: float, y0: float, x1: float, y1: float) -> None:
        self._wall(x0, x1, y0, NICHE, 1)
        self._wall(x0, x1, y1, -NICHE, 1)
        self._wall(y0, y1, x0, NICHE, -1)
        self._wall(y0, y1, x1, -NICHE, -1)

    def _wall(self, begin: float, end: float, at: float, niche: float, axis: int) -> None:
        """Along x (``axis`` 1) or y (-1), with doors that are set back by ``niche`` [m]."""

        def part(a: float, b: float, before: float, behind: float) -> None:
            (p, q), (u, v) = (a, at + before)[::axis], (b, at + behind)[::axis]
            self._walls.append((p, q, u, v))

        t = begin
        while t < end:
            door = min(t + self.rng.uniform(3.0, 9.0), end)
            after = min(door + 1.0, end)
            part(t, door, 0.0, 0.0)
            part(door, door, 0.0, niche)
            part(door, after, niche, niche)
            part(after, after, niche, 0.0)
            t = after


def _box(x0: float, y0: float, x1: float, y1: float) -> Walls:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]
