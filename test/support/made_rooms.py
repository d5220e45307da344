# SPDX-License-Identifier: Apache-2.0
"""Tiny worlds of wall segments, and noiseless or noisy scans of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params, se2
from rlml_slam.matching.scans.submap import Submap

Array = NDArray[np.float64]


def walls(*corners: tuple[float, float]) -> Array:
    """Segments (n, 2, 2) of a closed polygon."""
    p = np.array(corners)
    return np.stack([p, np.roll(p, -1, axis=0)], axis=1)


def moved(T: Array, segments: Array) -> Array:
    """The world moved by the pose T."""
    return se2.transform(T, segments.reshape(-1, 2)).reshape(segments.shape)


# no two walls that could be mistaken for each other
ROOM = walls((-3.1, -2.2), (4.3, -2.2), (4.3, 1.1), (2.4, 1.1), (2.4, 2.7), (-3.1, 2.7))
CORRIDOR = np.array([[[-40.0, -1.0], [40.0, -1.0]], [[-40.0, 1.0], [40.0, 1.0]]])


def scan(
    segments: Array,
    pose: Array,
    beams: int = 720,
    sigma: float = 0.0,
    seed: int = 0,
    max_range: float = 15.0,
) -> Array:
    """End points (n, 2) in the frame of ``pose``, all around, in scan order."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False) + 0.001
    d = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], -1)[:, None]
    a, e = segments[:, 0] - pose[:2], segments[:, 1] - segments[:, 0]
    cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        u = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    t = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf)
    r = t.min(axis=1)
    seen = r < max_range
    r, angles = r[seen], angles[seen]
    r = r + sigma * np.random.default_rng(seed).normal(size=len(r))
    return np.stack([r * np.cos(angles), r * np.sin(angles)], -1)


def built(
    segments: Array,
    poses: Array,
    sigma: float = 0.0,
    beams: int = 720,
    parameters: params.Submap | None = None,
) -> Submap:
    """Submap of scans from known poses."""
    submap = Submap(parameters or params.Submap())
    for k, pose in enumerate(poses):
        points = scan(segments, pose, beams, sigma, seed=k)
        submap.insert(se2.transform(pose, points), pose[:2])
    return submap


def path(n: int = 8) -> Array:
    """Poses (n, 3) that wander through the middle of the room."""
    f = np.linspace(0.0, 1.0, n)
    return np.stack([-0.5 + f, 0.3 * np.sin(4.0 * f), 0.8 * f - 0.3], -1)
