# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study lifelong``: hours in one hall, in which reflectors are moved.

The robot drives its loop again and again with the whole system. Half-way, some reflectors are put
elsewhere. Of each part of the time, the study reports the size of the map, the cost of a keyframe,
and the error of the poses.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2, warm_up
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.usage import usage
from rlml_slam.errors import ParameterError
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping
from rlml_slam.ros.memory import give_back, keep_large_apart
from rlml_slam.se2 import Array
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world import Geometry, ReflectorSet, World
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Imu, Odometry, Scan

HOUR = 3600.0
POSTS = 13  # reflectors that the hall gets besides its own 17
MOVED, FAR = 5, 1.5  # [m] how many of the 30 are moved, and how far
SEEN = 0.1  # share of the route from which a post can be seen
REACH, CLEARANCE = 20.0, 0.05  # [m] from which, and how far before a wall it stands
CLOSE = 0.15  # [m] a reflector of the map this near to a true one is that one
COLUMNS: dict[str, tuple[str, str]] = {
    'keyframes': ('keyframes', 'd'),
    'edges': ('edges', 'd'),
    'sightings': ('sightings', 'd'),
    'submaps': ('submaps', 'd'),
    'memory_mb': ('memory [MB]', '.1f'),
    'grown_mb': ('since start [MB]', '.1f'),
    'median_ms': ('median [ms]', '.2f'),
    'p99_ms': ('p99 [ms]', '.2f'),
    'live_ate_rmse_m': ('live ATE [m]', '.4f'),
}
TITLES = ('hours', *(title for title, _ in COLUMNS.values()))


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study lifelong``."""
    parser = subparsers.add_parser(
        'lifelong',
        help='hours in one hall: size of the map and cost of a keyframe',
        description='Drives the loop of the hall for simulated hours. Half-way, 5 of its 30 '
        'reflectors are moved. Times are those of the processor, per keyframe of the back end.',
    )
    parser.add_argument('--hours', type=float, default=8.0, help='default: %(default)s')
    parser.add_argument('--parts', type=int, default=8, help='rows (default: %(default)s)')
    parser.add_argument('--hz', type=float, default=4.0, help='scans (default: %(default)s)')
    parser.add_argument('--beams', type=int, default=180, help='per scan (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=0, help='default: %(default)s')
    parser.add_argument(
        '--keep-all', action='store_true', help='keep all keyframes, for comparison'
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Drive and print a row per part."""
    if not args.hours > 0.0 or args.parts < 2:
        raise ParameterError('study lifelong: --hours must be above 0 and --parts 2 or more')
    params = Parameters()
    if args.keep_all:
        params = replace(params, back_end=replace(params.back_end, keyframes_per_place=0))
    simulator = from_mapping(
        {'laser.rate': args.hz, 'laser.beams': args.beams, 'truth_rate': args.hz, 'repeat': True,
         'duration': HOUR * args.hours},
        SimulatorParameters,
    )  # fmt: skip
    if args.json:
        print(json.dumps(drive(params, simulator, args.seed, args.parts)))
        return 0
    print(line(TITLES), flush=True)

    def print_part(r: dict[str, Any]) -> None:
        print(cells(r), flush=True)

    figures = drive(params, simulator, args.seed, args.parts, print_part)
    print(verdict(figures['reflectors']))
    return 0


def drive(
    params: Parameters,
    simulator: SimulatorParameters,
    seed: int,
    parts: int,
    report: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """The whole drive; a dictionary per part, and what became of the reflectors.

    Each part is reported as soon as it is over, and how far the drive is.
    """
    keep_large_apart()
    rng = np.random.default_rng(seed)
    world = loop_of(load_world(simulator.node.world), rng)
    simulation = Simulation(world, simulator, seed)
    slam = Slam(params)
    warm_up.compile_loaded()
    gc.freeze()  # as the live nodes do (ros/run.py), for which these figures stand
    slam.set_sensor_pose(simulator.node.laser_frame, np.array(simulator.node.laser_pose))
    moved = rng.choice(len(world.reflectors), MOVED, replace=False)
    duration = simulator.node.duration
    rows: list[dict[str, Any]] = []
    errors: list[float] = []
    is_moved = False
    before = resident_mb()

    def end_part(t: float) -> None:
        rows.append(row(slam, errors, t, before))
        errors.clear()
        if report is not None:
            report(rows[-1])

    with Progress('lifelong', duration, report is None) as progress:
        for event in simulation:
            t = simulation.progress * duration
            if not is_moved and t >= 0.5 * duration:
                simulation.move_reflectors(moved_points(world, moved, rng))
                is_moved = True
            message = event.message
            if isinstance(message, GroundTruth):
                continue
            if isinstance(message, Odometry):
                frames = slam.add_odometry(message)
            elif isinstance(message, Imu):
                frames = slam.add_imu(message)
            elif isinstance(message, Scan):
                frames = slam.add_scan(message)
            else:
                frames = slam.add_detections(message)
            for f in frames:
                e = se2.between(simulation.truth(f.stamp).T_map_base, f.T_map_base)
                errors.append(float(e[0] ** 2 + e[1] ** 2))
            due = duration * (len(rows) + 1) / parts
            if frames and len(rows) < parts - 1 and t >= due:
                end_part(t)
            if frames:
                progress.update(t, f'{len(slam.back_end.keyframes)} keyframes')
    slam.finish()
    end_part(duration)
    return {'parts': rows, 'reflectors': evaluate(slam, world, simulation.world, moved)}


def loop_of(world: World, rng: np.random.Generator) -> World:
    """The route up to where it comes back to its start; more reflectors, on posts at walls.

    Each post can be seen from a good part of the route.
    """
    back = np.flatnonzero((world.route[1:] == world.route[0]).all(-1))
    route = world.route[: back[0] + 2] if len(back) else np.vstack([world.route, world.route[:1]])
    low, high = world.static.segments[:, :2].min(0), world.static.segments[:, :2].max(0)
    points = np.zeros((0, 2))
    while len(points) < POSTS:
        p = rng.uniform(low + 0.1, high - 0.1)
        side = rng.integers(4)
        p[side // 2] = (low + 0.1, high - 0.1)[side % 2][side // 2]
        others = np.vstack([points, world.reflectors.points])
        apart = np.hypot(*(others - p).T).min() > 2.0 * FAR
        if apart and in_view(world.static, route, p) > SEEN:
            points = np.vstack([points, p])
    r = world.reflectors
    more = ReflectorSet(
        np.vstack([r.points, points]),
        np.append(r.widths, np.full(POSTS, 0.08)),
        np.append(r.normals, np.full(POSTS, np.nan)),
        np.append(r.ids, r.ids.max() + 1 + np.arange(POSTS)),
    )
    return replace(world, route=route, reflectors=more)


def moved_points(world: World, moved: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """All reflectors, those with indices ``moved`` a way off, to where they can be seen."""
    points = world.reflectors.points.copy()
    for k in moved:
        for _ in range(1000):
            way = rng.uniform(-np.pi, np.pi)
            p = points[k] + FAR * np.array([np.cos(way), np.sin(way)])
            if in_view(world.static, world.route, p) > SEEN:
                points[k] = p
                break
    return points


def in_view(static: Geometry, route: Array, point: Array) -> float:
    """Share of a route (k, 2) from which nothing stands before a point (2,), in range."""
    legs = np.diff(route, axis=0)
    steps = [np.linspace(0.0, 1.0, 1 + int(np.hypot(*leg))) for leg in legs]
    eyes = np.concatenate(
        [a + s[:, None] * leg for a, s, leg in zip(route[:-1], steps, legs, strict=True)]
    )
    d = point - eyes
    far = np.hypot(*d.T)
    ranges, _, _ = cast(eyes, np.arctan2(d[:, 1], d[:, 0]), np.zeros(len(d)), static, 1000.0)
    free = ranges > far + CLEARANCE
    return float(np.mean(free & (far < REACH)))


def resident_mb() -> float:
    """Memory of this process [MB], 0 where the system does not say."""
    now = usage(os.getpid(), 0.0)
    return 0.0 if now is None else now.rss_mb


def row(slam: Slam, errors: list[float], t: float, before_mb: float) -> dict[str, Any]:
    """Sizes at ``t`` [s], and cost and error since the last row."""
    back_end = slam.back_end
    ms = np.array([u.cpu_ms for u in slam.updates])
    slam.updates.clear()
    give_back()  # as the back end's node does after each map
    memory_mb = resident_mb()
    return {
        'hours': t / HOUR,
        'keyframes': len(back_end.keyframes),
        'edges': int(back_end.graph.edges.enabled.sum()),
        'sightings': int(back_end.graph.sightings.enabled.sum()),
        'submaps': back_end.scan_graph.num_submaps,
        'memory_mb': memory_mb,
        'grown_mb': memory_mb - before_mb,
        'taken': len(ms),
        'median_ms': float(np.median(ms)),
        'p99_ms': float(np.percentile(ms, 99)),
        'max_ms': float(ms.max()),
        'live_ate_rmse_m': float(np.sqrt(np.mean(errors))),
    }


def evaluate(slam: Slam, before: World, after: World, moved: NDArray[np.int64]) -> dict[str, Any]:
    """How many reflectors of each sort the map has, and how far the unmoved ones in it are off."""
    found = slam.reflectors()
    start = se2.inverse(before.start)
    old, new = (se2.transform(start, w.reflectors.points) for w in (before, after))
    still = np.setdiff1d(np.arange(len(old)), moved)

    def near(points: Array) -> Array:
        gap = np.linalg.norm(points[:, None] - found.points[None], axis=-1)
        return np.asarray(gap.min(axis=1, initial=np.inf))

    gaps = near(old[still])
    there = gaps[gaps < CLOSE]
    states = slam.back_end.reflector_states()

    def classified(points: Array, *kinds: str) -> int:
        """How many of ``points`` are classified as one of some kinds."""
        at = [s.origin.place if s.origin else s.place for s in states if s.state in kinds]
        gap = np.linalg.norm(points[:, None] - np.array(at).reshape(-1, 2)[None], axis=-1)
        return int((gap.min(axis=1, initial=np.inf) < CLOSE).sum())

    return {
        'mapped': len(found),
        'unmoved_mapped': len(there),
        'unmoved': len(still),
        'unmoved_present': classified(old[still], 'present'),
        'unmoved_rmse_m': float(np.sqrt(np.mean(there**2))) if len(there) else None,
        'moved_mapped': int((near(new[moved]) < CLOSE).sum()),
        'moved_found': classified(old[moved], 'moved'),
        'moved_still_at_old_place': int((near(old[moved]) < CLOSE).sum()),
        'moved': len(moved),
    }


def line(words: Sequence[str]) -> str:
    """A line of the table; no figure is wider than its title."""
    return '  '.join(f'{w:>{len(t)}}' for w, t in zip(words, TITLES, strict=True))


def cells(r: dict[str, Any]) -> str:
    """A row of the table."""
    return line([f'{r["hours"]:.2f}', *(f'{r[k]:{f}}' for k, (_, f) in COLUMNS.items())])


def verdict(r: dict[str, Any]) -> str:
    """What became of the reflectors, for people."""
    off = r['unmoved_rmse_m']
    by = '' if off is None else f', off by {100 * off:.1f} cm'
    return (
        f'{r["unmoved_mapped"]} of {r["unmoved"]} reflectors that stayed are in the map{by}; '
        f'{r["moved_mapped"]} of {r["moved"]} that were '
        f'moved are mapped, {r["moved_found"]} classified as moved, '
        f'{r["moved_still_at_old_place"]} still where they were; {r["mapped"]} in all, '
        f'{r["unmoved_present"]} of those that stayed without a change'
    )
