# SPDX-License-Identifier: Apache-2.0
"""A robot beside a moving, deforming carrier: odometry, reflector detections and the truth.

Two carriers: a train, whose features stay together and turn with it, and a conveyor, whose
features enter upstream and leave downstream. The robot follows the carrier's nominal motion.
Everything is in the frame of the robot's first pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_slam.se2 import Array, between, compose, exp, rotation
from rlml_slam.types import ANONYMOUS, Detections, Motion


@dataclass(frozen=True)
class CarrierStep:
    """One step as measured, and the truth of it."""

    stamp: int
    motion: Motion  # since the step before, with its covariance
    detections: Detections  # in the robot's frame
    linear: Array  # (2,) nominal velocity of the carrier's features' centroid since then
    angular: float
    pose: Array  # (3,) true
    ids: NDArray[np.int64]  # (m,) of the features that exist
    points: Array  # (m, 2) true
    seen: NDArray[np.int64]  # (k,) true id of each detection, ANONYMOUS for a ghost


def simulate_carrier(settings: Carrier, seed: int) -> Iterator[CarrierStep]:
    """Steps without end; the same for the same settings and seed."""
    generator = np.random.default_rng(seed)
    dt = 1.0 / settings.rate
    pose, time = np.zeros(3), 0.0
    points = generator.uniform(-0.3, 0.3, (settings.features, 2))
    points[:, 1] += 2.0
    points[:, 0] += 1.2 * (np.arange(settings.features) - (settings.features - 1) / 2.0)
    points[:, 1] += 0.8 * (-1.0) ** np.arange(settings.features)
    ids = np.arange(settings.features, dtype=np.int64)
    motion = Motion(np.zeros(3), np.diag(np.array(settings.odometry_sigma) ** 2 * dt + 1e-24))
    linear, angular, k = np.zeros(2), 0.0, 0
    while True:
        detections, seen = _detect(settings, generator, k, dt, pose, ids, points)
        stamp = round(1e9 * k * dt)
        yield CarrierStep(stamp, motion, detections, linear, angular, pose, ids, points, seen)
        k, time = k + 1, time + dt
        angular = settings.turn_rate * np.sin(0.3 * time) if settings.kind == 'train' else 0.0
        heading = settings.turn_rate / 0.3 * (1.0 - np.cos(0.3 * time))
        direction = heading if settings.kind == 'train' else 0.0
        speed = settings.speed * (1.0 + 0.3 * np.sin(0.2 * time))
        linear = speed * np.array([np.cos(direction), np.sin(direction)])
        pose, motion = _drive(
            settings, generator, dt, pose, points, np.array([speed, direction, angular])
        )
        points = _carry(settings, generator, dt, points, linear, angular)
        if settings.kind == 'conveyor':
            ids, points = _feed(settings, pose, ids, points)


def _drive(
    settings: Carrier, generator: np.random.Generator, dt: float, pose: Array, points: Array,
    carrier: Array,
) -> tuple[Array, Motion]:  # fmt: skip
    """A wheeled robot stays beside the carrier, or lets a conveyor pass; true pose and odometry.

    ``carrier`` = (speed, direction, turn rate). The steering is Kanayama's tracking law.
    """
    speed, direction, turn = carrier
    beside = np.array([*points.mean(axis=0), direction])
    beside = compose(beside, np.array([0.0, -2.0, 0.0]))  # the carrier 2 m to the left
    ahead, aside, astray = between(pose, beside)
    if settings.kind == 'train':
        v, w = speed + 2.0 * turn, turn
    else:
        v, w, ahead = 0.6 * speed, 0.0, 0.0
    w += v * (0.25 * aside + np.sin(astray))
    v = v * np.cos(astray) + 0.5 * ahead
    command = exp(np.array([v, 0.0, w]) * dt)
    sigma = np.array(settings.odometry_sigma) * [1.0, abs(v), 1.0] * np.sqrt(dt)
    true = command + sigma * generator.standard_normal(3)
    return compose(pose, true), Motion(command, np.diag(sigma**2 + 1e-24))


def _carry(
    settings: Carrier, generator: np.random.Generator, dt: float, points: Array,
    linear: Array, angular: float,
) -> Array:  # fmt: skip
    """The features one step on: nominal motion about their centroid, and both random walks."""
    center = points.mean(axis=0)
    moved = center + (points - center) @ rotation(angular * dt).T + linear * dt
    own = settings.drift * np.sqrt(dt) * generator.standard_normal(points.shape)
    common = settings.common_drift * np.sqrt(dt) * generator.standard_normal(2)
    carried: Array = moved + own + common
    return carried


def _feed(
    settings: Carrier, pose: Array, ids: NDArray[np.int64], points: Array
) -> tuple[NDArray[np.int64], Array]:
    """A conveyor's feature that is far downstream comes back upstream as a new one."""
    ids, points = ids.copy(), points.copy()
    for j in np.flatnonzero(points[:, 0] - pose[0] > settings.max_range + 1.0):
        points[j] = (pose[0] - settings.max_range - 0.5, points[j, 1])
        ids[j] = np.max(ids) + 1
    return ids, points


def _detect(
    settings: Carrier, generator: np.random.Generator, k: int, dt: float, pose: Array,
    ids: NDArray[np.int64], points: Array,
) -> tuple[Detections, NDArray[np.int64]]:  # fmt: skip
    """Detections of what is in range, some missing, some ghosts, in random order."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    body = (points - pose[:2]) @ np.array([[c, -s], [s, c]])
    noisy = body + settings.sigma * generator.standard_normal(body.shape)
    kept = (np.linalg.norm(body, axis=-1) <= settings.max_range) & (
        generator.random(len(body)) >= settings.missed_share
    )
    num = generator.poisson(settings.false_detections)
    ghosts = generator.uniform(-settings.max_range, settings.max_range, (num, 2))
    found = np.concatenate([noisy[kept], ghosts])
    seen = np.concatenate([ids[kept], np.full(num, ANONYMOUS, dtype=np.int64)])
    order = generator.permutation(len(found))
    found, seen = found[order], seen[order]
    ids = seen if settings.ids else np.full(len(seen), ANONYMOUS, dtype=np.int64)
    cov = np.broadcast_to(settings.sigma**2 * np.eye(2), (len(found), 2, 2)).copy()
    stamp = round(1e9 * k * dt)
    diameters = np.full(len(found), np.nan)
    return Detections(stamp, 'base_link', found, cov, ids, diameters), seen


def true_features(step: CarrierStep) -> dict[int, Array]:
    """True position (2,) of each feature by its id."""
    return dict(zip(step.ids.tolist(), step.points, strict=True))
