# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study building``: large loops in made buildings, and whether each closure is right.

The robot drives around the building, back to where it began, and through corridors between; its
laser looks ahead only, and its odometry is a poor one. Rooms and corridors look alike, and a
scan that is displaced by the width of a corridor fits there almost as well.

``--closed`` closes all doors: then nothing but their niches, and crossings, says how far the robot
is. ``--stall`` lets the odometry stand still again and again, and then catch up in one step;
``--cut`` leaves out all messages. In a bare corridor no scan says how far the robot drove
meanwhile.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.support.office_building import CORRIDOR, PITCH, Building, ClosedBuilding
from rlml_slam import se2
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Frame, Level, Odometry, Scan

SPEED, TURN = 0.7, 0.6  # [m/s], [rad/s] of the robot
SWAY, WAVE = 0.35, 9.0  # [m] to the sides of the middle of a corridor, [m] along it per radian
LASER = np.array([0.1, 0.0, 0.0])  # pose in base
VIEW = np.radians(np.arange(-90.0, 91.0))  # [rad] beams of the laser
REACH, NOISE, LOST = 40.0, 0.015, 0.02  # [m], [m], share of beams without a return
# sigmas of the odometry's errors: of its scales, turn per way [rad/m], and walks of the heading
SCALE, TURN_SCALE, BENT = 0.01, 0.03, 0.002
WALK, TURN_WALK = 0.008, 0.01  # [rad/sqrt(m)], [rad/sqrt(rad)]
RIGHT = 0.5  # [m] a closure with less error is right, and a pose
START = 10**12  # [ns]
HEADER = (
    'seed', 'scans', 'odometry [m]', 'before closing [m]', 'rms [m]', 'largest [m]', 'right',
    'wrong', 'enabled wrong', 'OK and wrong', 'x real time',
)  # fmt: skip


@dataclass(frozen=True)
class Drive:
    """Of one building: ``size`` [m], ``rate`` of scans [Hz], ``speed`` [m/s], errors of odometry.

    Every ``interval`` [s] it stands still for ``stall`` [s], or all is missing for ``cut`` [s].
    """

    size: float
    rate: float = 5.0
    poor: float = 1.0
    speed: float = SPEED
    stall: float = 0.0
    cut: float = 0.0
    interval: float = 60.0
    closed: bool = False


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study building``."""
    parser = subparsers.add_parser(
        'building', help='large loops in made buildings: whether each closure is right',
        description=__doc__,
    )  # fmt: skip
    parser.add_argument('--size', type=float, default=100.0, help='of the building [m]')
    parser.add_argument('--rate', type=float, default=5.0, help='of the scans [Hz]')
    parser.add_argument('--poor', type=float, default=1.0, help="factor of the odometry's errors")
    parser.add_argument('--speed', type=float, default=SPEED, help='of the robot [m/s]')
    parser.add_argument('--stall', type=float, default=0.0, metavar='S', help='of the odometry')
    parser.add_argument('--cut', type=float, default=0.0, metavar='S', help='without any message')
    parser.add_argument('--every', type=float, default=60.0, metavar='S', help='for both of these')
    parser.add_argument('--closed', action='store_true', help='all doors')
    parser.add_argument('--seeds', type=int, default=3, help='number of buildings')
    parser.add_argument('--first', type=int, default=0, help='the first seed')


def run(args: argparse.Namespace) -> int:
    """Drive through each building and print a row."""
    how = Drive(
        args.size, args.rate, args.poor, args.speed, args.stall, args.cut, args.every, args.closed
    )  # fmt: skip
    seeds = range(args.first, args.first + args.seeds)
    print(aligned([HEADER, *((f'{seed}', *drive(how, seed)) for seed in seeds)]))
    return 0


def route(size: float, interval: float, speed: float = SPEED) -> Array:
    """True poses (n, 3), one every ``interval`` [s]."""
    n = max(round(size / PITCH), 1)
    half = n // 2
    nodes = [
        (0, 0), (n, 0), (n, n), (0, n), (0, 0), (1, 0), (half, 0), (half, n), (0, n), (0, half),
        (n, half), (n, 0), (half, 0),
    ]  # fmt: skip
    nodes = [b for a, b in itertools.pairwise(((-1, -1), *nodes)) if a != b]
    points = np.array(nodes) * (size - CORRIDOR) / n + 0.5 * CORRIDOR
    out, heading = list[Array](), 0.0
    for a, b in itertools.pairwise(points):
        way = b - a
        far, course = math.hypot(*way), math.atan2(way[1], way[0])
        turn = se2.wrapped(course - heading)
        steps = max(int(abs(turn) / (TURN * speed / SPEED) / interval), 1)
        out += [np.array([*a, heading + turn * (k + 1) / steps]) for k in range(steps)]
        steps = max(int(far / speed / interval), 1)
        s = far * (np.arange(steps) + 1.0) / steps
        aside = SWAY * np.sin(s / WAVE) * np.sin(np.pi * s / far)
        across = np.array([-way[1], way[0]]) / far
        places = a + s[:, None] * way / far + aside[:, None] * across
        out += [np.array([*p, course]) for p in places]
        heading = course
    return np.array(out)


def odometry_of(poses: Array, poor: float, rng: np.random.Generator) -> Array:
    """Odometry (n, 3) with errors ``poor`` times the usual ones."""
    scale, turn_scale = 1.0 + poor * np.array([SCALE, TURN_SCALE]) * rng.standard_normal(2)
    bent = poor * BENT * rng.standard_normal()
    out = [np.zeros(3)]
    for step in se2.between(poses[:-1], poses[1:]):
        far = math.hypot(step[0], step[1])
        walk = WALK * math.sqrt(far) + TURN_WALK * math.sqrt(abs(step[2]))
        turn = turn_scale * step[2] + bent * far + poor * walk * rng.standard_normal()
        out.append(se2.compose(out[-1], np.array([*(scale * step[:2]), turn])))
    return np.array(out)


def is_within(stamps: Array, interval: float, lasts: float, start: float) -> NDArray[np.bool_]:
    """Which of ``stamps`` (n,) [s] are in the first ``lasts`` [s] of an interval, from a start."""
    inside: NDArray[np.bool_] = (stamps >= start) & ((stamps - start) % interval < lasts)
    return inside


def drive(how: Drive, seed: int) -> tuple[str, ...]:
    """The row of one building."""
    kind = ClosedBuilding if how.closed else Building
    building, rng = kind(seed, how.size), np.random.default_rng(seed + 100)
    poses = route(how.size, 1.0 / how.rate, how.speed)
    odometry = odometry_of(poses, how.poor, rng)
    seconds, start = np.arange(len(poses)) / how.rate, how.interval * float(rng.random())
    stalls = is_within(seconds, how.interval, how.stall, start)
    kept = ~is_within(seconds, how.interval, how.cut, start)
    for k in (np.flatnonzero(stalls[1:]) + 1).tolist():
        odometry[k] = odometry[k - 1]
    slam, frames = Slam(Parameters()), list[Frame]()
    slam.set_sensor_pose('laser', LASER)
    stamps, spent = START + np.round(seconds * 1e9).astype(np.int64), 0.0
    for k in np.flatnonzero(kept).tolist():
        stamp = int(stamps[k])
        scan = Scan(
            stamp, 'laser', float(VIEW[0]), float(VIEW[1] - VIEW[0]), 0.0, 0.05, 80.0,
            ranges(building, poses[k], rng), np.zeros(0, np.float32),
        )  # fmt: skip
        began = time.perf_counter()
        frames += [*slam.add_odometry(Odometry(stamp, odometry[k])), *slam.add_scan(scan)]
        spent += time.perf_counter() - began
    began = time.perf_counter()
    frames += slam.finish()
    spent += time.perf_counter() - began
    return figures(slam, frames, dict(zip(stamps.tolist(), poses, strict=True)), odometry, spent)


def ranges(building: Building, pose: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """Of one sweep; beams without a return are beyond the largest range."""
    x, y, heading = se2.compose(pose, LASER)
    n = len(VIEW)
    at = np.tile((x, y), (n, 1))
    r, _, _ = cast(at, heading + VIEW, np.zeros(n), building.geometry, REACH)
    r = r + NOISE * rng.standard_normal(n)
    r[~np.isfinite(r) | (rng.random(n) < LOST)] = 81.9
    return r.astype(np.float32)


def figures(
    slam: Slam, frames: list[Frame], true: dict[int, Array], odometry: Array, spent: float
) -> tuple[str, ...]:
    """The row: errors where both ways fit best."""
    stamps, found = slam.back_end.trajectory()
    truth = np.array([true[t][:2] for t in stamps.tolist()])
    T = se2.align(found[:, :2], truth)
    error = np.hypot(*(se2.transform(T, found[:, :2]) - truth).T)
    live = np.array([f.T_map_base[:2] for f in frames])
    away = se2.transform(T, live) - np.array([true[f.stamp][:2] for f in frames])
    off = np.hypot(*away.T)
    sigma = np.sqrt([np.trace(f.cov_map[:2, :2]) for f in frames])
    ok = np.array([f.health.level is Level.OK for f in frames])
    keys, begin = slam.back_end.keyframes, next(iter(true.values()))
    right, wrong, enabled = 0, 0, 0
    submaps = {m.anchor.index: m for m in slam.back_end.scan_graph.finished}
    for c in slam.back_end.loop_closer.records.accepted():
        if c.i not in submaps:
            continue
        measured = se2.compose(submaps[c.i].T_anchor_grid, c.delta)
        e = se2.between(se2.between(true[keys[c.i].stamp], true[keys[c.j].stamp]), measured)
        is_right = math.hypot(e[0], e[1]) < RIGHT
        right, wrong = right + is_right, wrong + (not is_right)
        enabled += int(not is_right and slam.back_end.graph.edges.enabled[c.edge])
    end = se2.compose(begin, odometry[-1])[:2] - next(reversed(true.values()))[:2]
    seconds = (stamps[-1] - stamps[0]) / 1e9
    return (
        f'{len(frames)}', f'{math.hypot(*end):.1f}', f'{off.max():.2f}',
        f'{math.sqrt(np.mean(error**2)):.3f}', f'{error.max():.2f}', f'{right}', f'{wrong}',
        f'{enabled}', f'{np.mean(ok & (off > RIGHT) & (off > 3.0 * sigma)):.2%}',
        f'{seconds / spent:.0f}',
    )  # fmt: skip
