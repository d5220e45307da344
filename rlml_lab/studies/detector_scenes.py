# SPDX-License-Identifier: Apache-2.0
"""Simulated scans that try a reflector detector: cylinders all around, and rooms without any."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.params import Laser
from rlml_slam.se2 import Array
from rlml_slam.simulation.robot import Track
from rlml_slam.simulation.sensors import LaserSensor
from rlml_slam.simulation.simulation import START
from rlml_slam.simulation.world import NO_REFLECTOR, Geometry, box_corners
from rlml_slam.types import Scan

Rng = np.random.Generator
AROUND = 12  # cylinders in one scan
GLOSSY = 0.8  # share of mirror-like reflection of what is glossy, as in world files
ROOM = (2.0, 12.0)  # [m] half the length of a room's sides
CLEAR = 0.25  # [m] nothing is nearer to the laser


class StillLaser:
    """A laser that stands at the origin; each scan has its own noise."""

    def __init__(self, laser: Laser, seed: int) -> None:
        self._track = Track(START, np.zeros(3))
        self._track.advance()
        self._sensor = LaserSensor(
            laser, np.zeros(3), 'laser',
            lambda name: np.random.default_rng([seed, len(name), ord(name[0])]),
        )  # fmt: skip

    def scan(self, geometry: Geometry) -> Scan:
        """One sweep."""
        return self._sensor.measure(self._track, START, geometry, START + self._sensor.sweep // 2)


def surface(reflectance: float, glossy: bool = False, retro: bool = False) -> Array:
    """A row of a geometry's surface table."""
    gloss = GLOSSY if glossy else 0.0
    return np.array([reflectance, gloss, float(retro), NO_REFLECTOR])


class Scene:
    """Segments and discs one by one."""

    def __init__(self) -> None:
        self._segments: list[Array] = []
        self._discs: list[Array] = []
        self._rows: tuple[list[Array], list[Array]] = ([], [])

    def add_box(self, pose: Array, size: tuple[float, float], rows: list[Array]) -> None:
        """A box seen from outside; ``rows`` of its front, right, back and left side."""
        a = box_corners(pose, size)
        b = np.roll(a, -1, axis=0)
        self._add_segments(a, b, rows)

    def add_room(self, half: Array, rows: list[Array]) -> None:
        """Four walls seen from inside."""
        a = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        self._add_segments(a, np.roll(a, -1, axis=0), rows)

    def add_disc(self, at: Array, diameter: float, velocity: Array, row: Array) -> None:
        """A cylinder, standing or walking."""
        self._discs.append(np.array([*at, 0.5 * diameter, *velocity]))
        self._rows[1].append(row)

    def _add_segments(self, a: Array, b: Array, rows: list[Array]) -> None:
        self._segments += list(np.concatenate([a, b, np.zeros_like(a)], -1))
        self._rows[0].extend(rows)

    def geometry(self) -> Geometry:
        """All of it."""
        return Geometry(
            np.array(self._segments).reshape(-1, 6),
            np.array(self._discs).reshape(-1, 5),
            np.array(self._rows[0] + self._rows[1]).reshape(-1, 4),
        )


def cylinders(rng: Rng, diameter: float, distance: float) -> tuple[Geometry, Array]:
    """Reflective cylinders around the laser, before the walls of a room; their centres (n, 2)."""
    step = 2.0 * math.pi / AROUND
    bearings = step * (np.arange(AROUND) + 0.4 * rng.random(AROUND))
    centres = distance * np.stack([np.cos(bearings), np.sin(bearings)], -1)
    scene = Scene()
    half = np.full(2, distance + rng.uniform(0.1, 3.0))
    scene.add_room(half, [surface(rng.uniform(0.2, 0.9)) for _ in range(4)])
    for centre in centres:
        scene.add_disc(centre, diameter, np.zeros(2), surface(0.5, retro=True))
    return scene.geometry(), centres


def room(rng: Rng, people: int, vests: int = 0) -> Geometry:
    """A room of walls, partitions, boxes and people, with the laser somewhere in it.

    There are no reflectors; half of the walls and of the partitions' long sides are glossy.
    The last ``vests`` people have a reflective band: around the chest, or around each leg.
    """
    scene = Scene()
    half = rng.uniform(*ROOM, 2)
    scene.add_room(
        half, [surface(rng.uniform(0.3, 0.9), bool(rng.random() < 0.5)) for _ in range(4)]
    )
    for k in range(6):  # partitions, glossy or not, and goods
        is_wall = k < 2
        size = np.array([rng.uniform(1.0, 4.0), 0.1]) if is_wall else rng.uniform(0.2, 2.0, 2)
        matt = surface(rng.uniform(0.1, 0.9))
        side = surface(rng.uniform(0.1, 0.9), bool(rng.random() < 0.5)) if is_wall else matt
        scene.add_box(
            np.array([*_place(rng, half, float(np.hypot(*size)) / 2), rng.uniform(-3.0, 3.0)]),
            (float(size[0]), float(size[1])), [matt, side, matt, side],
        )  # fmt: skip
    for _ in range(2):
        diameter = rng.uniform(0.03, 0.4)
        scene.add_disc(
            _place(rng, half, diameter / 2), diameter, np.zeros(2), surface(rng.uniform(0.1, 0.9))
        )
    for k in range(people):
        _add_person(scene, rng, half, k >= people - vests)
    # the laser stands off the middle, and the room is turned
    whole = scene.geometry()
    return _turned(whole, rng.uniform(-math.pi, math.pi))


def _place(rng: Rng, half: Array, radius: float) -> Array:
    """Somewhere in the room, not on the laser."""
    while True:
        at = rng.uniform(-half, half)
        if np.hypot(*at) > radius + CLEAR:
            return np.asarray(at)


def _add_person(scene: Scene, rng: Rng, half: Array, vest: bool) -> None:
    at = _place(rng, half, 0.5)
    walk = rng.uniform(0.0, 1.5)
    direction = rng.uniform(-math.pi, math.pi)
    velocity = walk * np.array([math.cos(direction), math.sin(direction)])
    row = surface(rng.uniform(0.1, 0.9), retro=vest)
    if rng.random() < 0.5:
        scene.add_disc(at, rng.uniform(0.3, 0.45), velocity, row)
        return
    across = np.array([-velocity[1], velocity[0]]) / max(walk, 1e-9)
    gap = rng.uniform(0.2, 0.35)
    for side in (-0.5, 0.5):
        scene.add_disc(at + side * gap * across, rng.uniform(0.12, 0.16), velocity, row)


def _turned(geometry: Geometry, angle: float) -> Geometry:
    """The geometry turned about the laser."""
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, s], [-s, c]])
    segments, discs = geometry.segments.copy(), geometry.discs.copy()
    for columns in (slice(0, 2), slice(2, 4), slice(4, 6)):
        segments[:, columns] = segments[:, columns] @ R
    for columns in (slice(0, 2), slice(3, 5)):
        discs[:, columns] = discs[:, columns] @ R
    return Geometry(segments, discs, geometry.surface)
