# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors are known, for the tests of what is made of a run."""

from __future__ import annotations

import numpy as np

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.types import Health, Level, Reflectors

SECOND = 1_000_000_000


def reflectors(points, ids=None, sigma=0.02):
    n = len(points)
    return Reflectors(
        np.arange(n, dtype=np.int64),
        np.array(points, dtype=np.float64).reshape(-1, 2),
        np.broadcast_to(sigma**2 * np.eye(2), (n, 2, 2)).copy(),
        np.full(n, -1, dtype=np.int64) if ids is None else np.array(ids, dtype=np.int64),
        np.full(n, 5, dtype=np.int64),
        np.full(n, np.nan),
    )


def circle(n=60, radius=3.0):
    phi = np.linspace(0.0, 2 * np.pi, n)
    poses = np.stack([radius * np.sin(phi), radius * (1 - np.cos(phi)), phi], -1)
    return Trajectory(SECOND * np.arange(1, n + 1, dtype=np.int64), poses)


def made_run(live_error=(0.03, 0.0, 0.0), sigma=0.03, is_map=True, name='circle'):
    """A circle whose live poses are off by a constant, and whose map is a square room."""
    truth = circle()
    log = FrameLog()
    for k, (stamp, pose) in enumerate(zip(truth.stamps, truth.poses, strict=True)):
        health = Health(Level.DEGRADED, ('saw 0 of 4',)) if 20 <= k < 30 else Health()
        cov = np.diag([sigma**2, sigma**2, 0.01**2])
        log.add_pose(int(stamp), pose + np.array(live_error), cov, health)
        log.wall_ms.append(1.0 + 0.1 * (k % 7))
        log.seen.append(4)
        log.used.append(3)
    cells = np.full((200, 200), -1, dtype=np.int8)
    cells[20:180, 20:180] = 0
    cells[20, 20:180] = cells[179, 20:180] = cells[20:180, 20] = cells[20:180, 179] = 100
    true = np.array([[4.0, 0.0], [-4.0, 6.0], [0.0, 7.0]])
    return Run(
        name,
        log,
        Trajectory(truth.stamps, truth.poses.copy()),
        reflectors(true[:2] + np.array([0.03, 0.04])),
        OccupancyGrid(0.05, (-5.0, -2.0), cells),
        truth.poses[::5],
        np.array([[[0.0, 0.0], [3.0, 3.0]]]),
        2,
        np.linspace(1.0, 4.0, 12),
        {'scan': {'used': 60, 'late': 0, 'invalid': 0}},
        Truth(truth, is_map, np.arange(3, dtype=np.int64), true),
        2.0,
    )
