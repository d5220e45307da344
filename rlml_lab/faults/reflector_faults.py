# SPDX-License-Identifier: Apache-2.0
"""Reflectors that are moved, hidden, dirty or mirrored, in a world or in its detections.

Detections with ids are made dirty or mirrored, then the ids are removed: the noise of all others
stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rlml_slam import se2
from rlml_slam.params import Markers
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.simulation.simulation import GroundTruth, Message
from rlml_slam.simulation.world import NO_REFLECTOR, Geometry, World, box_corners
from rlml_slam.types import ANONYMOUS, Detections

COVER = 0.4  # [m] side of the box that hides a reflector


def moved(world: World, k: int, offset: Array) -> World:
    """Reflector ``k`` stands ``offset`` (2,) [m] from where it was."""
    points = world.reflectors.points.copy()
    points[k] += offset
    return replace(world, reflectors=replace(world.reflectors, points=points))


def hidden(world: World, k: int) -> World:
    """A box stands around reflector ``k``."""
    a = box_corners(np.array([*world.reflectors.points[k], 0.0]), (COVER, COVER))
    segments = np.concatenate([a, np.roll(a, -1, axis=0), np.zeros((4, 2))], -1)
    surface = np.tile([0.5, 0.0, 0.0, NO_REFLECTOR], (4, 1))
    box = Geometry(segments, np.zeros((0, 5)), surface)
    return replace(world, static=world.static.joined(box))


def dirty(messages: Sequence[Message], id_: int, share: float, seed: int) -> list[Message]:
    """A ``share`` of the detections of one reflector is missing, of detections with ids."""
    rng, out = np.random.default_rng([seed, 1]), list(messages)
    for i, m in enumerate(messages):
        if isinstance(m, Detections):
            out[i] = _subset(m, (m.ids != id_) | (rng.random(len(m)) >= share))
    return out


def mirrored(
    messages: Sequence[Message], point: Array, wall: Array, laser: Array, n: Markers, seed: int
) -> list[Message]:
    """Detections of the image of ``point`` (2,) in the wall from ``wall[0]`` to ``wall[1]``.

    ``laser`` (3,) is the pose of the laser on the robot. An image is seen through the wall alone.
    """
    rng, out = np.random.default_rng([seed, 2]), list(messages)
    along = (wall[1] - wall[0]) / np.hypot(*(wall[1] - wall[0]))
    across = np.array([-along[1], along[0]])
    depth = (point - wall[0]) @ across
    image = point - 2.0 * depth * across
    true = [m for m in messages if isinstance(m, GroundTruth)]
    stamps = np.array([m.stamp for m in true])
    for i, m in enumerate(messages):
        noise, missed = rng.standard_normal(2), rng.random() < n.missed_share
        if not isinstance(m, Detections):
            continue
        pose = se2.compose(true[int(np.abs(stamps - m.stamp).argmin())].T_world_base, laser)
        gap = (pose[:2] - wall[0]) @ across
        r = float(np.hypot(*(image - pose[:2])))
        if missed or gap * depth <= 0.0 or r > n.max_range:
            continue
        crossing = pose[:2] + gap / (gap + depth) * (image - pose[:2])
        if not 0.0 <= (crossing - wall[0]) @ along <= np.hypot(*(wall[1] - wall[0])):
            continue
        z = se2.transform(se2.inverse(pose), image[None])[0]
        bearing = np.arctan2(z[1], z[0]) + n.sigma_bearing * noise[1]
        u = np.array([[np.cos(bearing), np.sin(bearing)]])
        d = r + n.sigma_range * noise[0]
        cov = polar_covariance(u, n.sigma_range**2, np.array([d * n.sigma_bearing]) ** 2)
        out[i] = replace(
            m, points=np.concatenate([m.points, d * u]), cov=np.concatenate([m.cov, cov]),
            ids=np.append(m.ids, ANONYMOUS), diameters=np.append(m.diameters, np.nan),
        )  # fmt: skip
    return out


def anonymous(messages: Sequence[Message]) -> list[Message]:
    """The same without ids."""
    return [
        replace(m, ids=np.full(len(m), ANONYMOUS)) if isinstance(m, Detections) else m
        for m in messages
    ]


def _subset(d: Detections, keep: Array) -> Detections:
    return replace(d, points=d.points[keep], cov=d.cov[keep], ids=d.ids[keep],
                   diameters=d.diameters[keep])  # fmt: skip
