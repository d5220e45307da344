# SPDX-License-Identifier: Apache-2.0
"""Tiny worlds, drives through them, and what a robot measures there, with or without noise."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace

import numpy as np

from rlml_slam import se2
from rlml_slam.types import ANONYMOUS, Detections, Motion, Observation, Odometry, Scan

SECOND = 1_000_000_000
STEP = SECOND // 10
FIRST = SECOND
BEAMS = 180
RANGE = 15.0


@dataclass(frozen=True)
class TinyWorld:
    """``walls`` (n, 4) = x0, y0, x1, y1 and ``reflectors`` (m, 2), in the world frame."""

    walls: np.ndarray
    reflectors: np.ndarray

    def without_reflectors(self):
        return replace(self, reflectors=np.zeros((0, 2)))


def polygon(*corners):
    p = np.array(corners, dtype=np.float64)
    return np.hstack([p, np.roll(p, -1, axis=0)])


# no two views alike, so that there is one place for each scan
ROOM = TinyWorld(
    np.vstack(
        [
            polygon((-2.0, -2.5), (6.0, -2.5), (6.0, 2.0), (4.5, 2.0), (4.5, 3.0), (-2.0, 3.0)),
            polygon((3.0, -0.6), (3.8, -0.4), (3.7, 0.2), (2.9, 0.0)),
        ]
    ),
    np.array([[-1.8, -2.2], [5.5, -2.2], [5.6, 1.7], [-1.7, 2.6], [1.5, 2.8], [2.2, -2.3]]),
)
OTHER_ROOM = TinyWorld(
    polygon((-1.0, -1.1), (1.3, -1.4), (2.4, 0.3), (0.4, 1.5), (-1.3, 0.8)), np.zeros((0, 2))
)
# longer than the laser sees, both ways
CORRIDOR = TinyWorld(
    np.array([[60.0, -1.2, -40.0, -1.2], [-40.0, 1.2, 60.0, 1.2]]), np.zeros((0, 2))
)


def drive(*legs, start=(0.0, 0.0, 0.0)):
    """Poses (n, 3) every 0.1 s; each leg is (v [m/s], omega [rad/s], duration [s])."""
    poses = [np.array(start, dtype=np.float64)]
    for v, w, duration in legs:
        for _ in range(round(duration * SECOND / STEP)):
            step = se2.exp(np.array([v, 0.0, w]) * STEP / SECOND)
            poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def cast(walls, pose, beams=BEAMS):
    """Ranges (beams,) over the whole circle from ``pose`` (3,), inf where nothing is hit."""
    angles = pose[2] - np.pi + np.arange(beams) * (2.0 * np.pi / beams)
    d = np.stack([np.cos(angles), np.sin(angles)], -1)[:, None]
    a, e = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        s = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    t = np.where((s >= 0.0) & (s <= 1.0) & (t > 0.0), t, np.inf)
    ranges = t.min(axis=1)
    return np.where(ranges < RANGE, ranges, np.inf)


def scan_at(world, pose, stamp, rng=None, sigma=0.01):
    """A raw sweep taken at one instant; noise where there is a generator."""
    ranges = cast(world.walls, pose)
    if rng is not None:
        ranges = ranges + sigma * rng.standard_normal(len(ranges))
    return Scan(
        stamp, 'laser', -np.pi, 2.0 * np.pi / BEAMS, 0.0, 0.05, RANGE + 1.0,
        ranges.astype(np.float32), np.zeros(0, dtype=np.float32),
    )  # fmt: skip


def points_of(scan):
    """End points (n, 2) of a sweep in the laser frame."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    hit = np.isfinite(scan.ranges)
    r = scan.ranges[hit].astype(np.float64)
    return np.stack([r * np.cos(angles[hit]), r * np.sin(angles[hit])], -1)


def detections_of(points, stamp, ids=None, sigma=0.02, frame='base_link'):
    """Detections at points (n, 2) with isotropic covariance sigma^2."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    n = len(points)
    ids = np.full(n, ANONYMOUS) if ids is None else np.asarray(ids)
    cov = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    return Detections(stamp, frame, points, cov, ids.astype(np.int64), np.full(n, np.nan))


def seen_at(world, pose, stamp, rng=None, sigma=0.02, ids=False, frame='base_link'):
    """Detections of the reflectors within RANGE, anonymous unless ``ids``."""
    z = se2.transform(se2.inverse(pose), world.reflectors)
    index = np.flatnonzero(np.hypot(z[:, 0], z[:, 1]) < RANGE)
    z = z[index]
    if rng is not None:
        z = z + sigma * rng.standard_normal(z.shape)
    return detections_of(z, stamp, index + 100 if ids else None, sigma, frame)


def motion_cov(delta):
    """A covariance (3, 3) of one step's odometry."""
    d, w = np.hypot(delta[0], delta[1]), abs(delta[2])
    return np.diag((np.array([0.1 * d, 0.05 * d, 0.1 * w + 0.05 * d]) + 1e-3) ** 2)


def observations(
    world, poses, *, scan=True, reflectors=True, odometry=True, rng=None, ids=False, sigma=0.02
):
    """What is measured along ``poses`` (n, 3); exact without a generator."""
    out = []
    for k, pose in enumerate(poses):
        stamp = FIRST + k * STEP
        delta = se2.between(poses[k - 1], pose) if k else np.zeros(3)
        cov = motion_cov(delta) if k else np.zeros((3, 3))
        if rng is not None and k:
            delta = delta + np.linalg.cholesky(cov) @ rng.standard_normal(3)
        motion = Motion(delta, cov)
        if not odometry:
            wide = np.diag(np.array([1.0, 1.0, 3.0]) * STEP / SECOND) ** 2
            motion = Motion(np.zeros(3), wide if k else np.zeros((3, 3)), known=False)
        out.append(
            Observation(
                stamp,
                motion,
                points_of(scan_at(world, pose, stamp, rng)) if scan else None,
                np.zeros(2) if scan else None,
                seen_at(world, pose, stamp, rng, sigma, ids) if reflectors else None,
                odom_pose=pose if odometry else None,
            )
        )
    return out


def within(seen, reach):
    """The observations with only those detections that are nearer than ``reach`` [m]."""
    out = []
    for o in seen:
        d = o.detections
        near = np.hypot(*d.points.T) < reach
        columns = {n: getattr(d, n)[near] for n in ('points', 'cov', 'ids', 'diameters')}
        out.append(dataclasses.replace(o, detections=dataclasses.replace(d, **columns)))
    return out


def messages(world, poses, *, scan=True, reflectors=True, odometry=True, rng=None, ids=False):
    """The same drive as raw messages in order of arrival; odometry has a rate of 20 Hz."""
    out = []
    for k, pose in enumerate(poses):
        stamp = FIRST + k * STEP
        if odometry:
            if k:
                half = se2.interpolate(poses[k - 1], pose, 0.5)
                out.append(Odometry(stamp - STEP // 2, half))
            out.append(Odometry(stamp, pose))
        if scan:
            out.append(scan_at(world, pose, stamp, rng))
        if reflectors:
            out.append(seen_at(world, pose, stamp, rng, ids=ids, frame='laser'))
    return out


def errors(estimates, poses):
    """Distance [m] and turn [rad] of each estimate (n, 3) from the truth (n, 3)."""
    e = se2.between(poses, estimates)
    return np.hypot(e[:, 0], e[:, 1]), np.abs(e[:, 2])
