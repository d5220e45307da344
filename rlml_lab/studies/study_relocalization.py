# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study relocalization``: whether reflectors give the pose, and whether it is right.

Each pose has a layout of its own, a map of it with errors, and detections of which a share is
missing and a share is ghosts. A layout that looks the same turned by half must never be unique,
and neither must detections that were made in another layout than the map's.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rlml_lab.support.parallel_jobs import add_workers, each, workers_of
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.matching.reflectors.constellation import Constellation, locate
from rlml_slam.matching.reflectors.pose_fit import warm_up
from rlml_slam.params import Relocalization
from rlml_slam.se2 import Array
from rlml_slam.types import Verdict

FEWEST, MOST = 12, 40  # reflectors of a layout
REACH = 25.0  # [m] of the reflector detector
NOISE = 0.03  # [m] largest sigma of a detection; each pose has one of its own below this
MAP_NOISE = 0.01  # [m] sigma of the reflectors of a map
MISSING, GHOSTS = 0.3, 0.3  # of the reflectors in reach; of all detections
RIGHT = (0.3, np.radians(3.0))  # [m], [rad] a pose with less error is the right one
COLUMNS: dict[str, tuple[str, str]] = {
    'unique': ('unique', '.2%'),
    'ambiguous': ('ambiguous', '.2%'),
    'impossible': ('impossible', '.2%'),
    'right_of_unique': ('right of unique', '.3%'),
    'truth_of_ambiguous': ('truth among ambiguous', '.2%'),
    'ambiguous_with_truth': ('ambiguous with truth', '.2%'),
    'error_m': ('error [m]', '.3f'),
    'nees': ('NEES (3)', '.2f'),
    'median_ms': ('median [ms]', '.2f'),
    'p99_ms': ('p99 [ms]', '.2f'),
    'largest_p99_ms': (f'p99 of {MOST} [ms]', '.2f'),
}


def hall(m: int, rng: np.random.Generator) -> Array:
    """Reflectors (m, 2) in a hall of 40 x 24 m: half on rows of pillars, half on the walls."""
    step = rng.uniform(5.0, 7.0, 2)  # a hall has one, and the next hall another
    x, y = np.meshgrid(np.arange(-2.5, 3.0) * step[0], np.arange(-1.0, 1.5) * step[1])
    pillars = rng.permutation(np.stack([x.ravel(), y.ravel()], -1))[: m // 2]
    side = rng.integers(4, size=m - len(pillars))
    u = rng.uniform(-1.0, 1.0, len(side))
    x = np.where(side < 2, 20.0 * u, np.where(side == 2, -20.0, 20.0))
    y = np.where(side < 2, np.where(side == 0, -12.0, 12.0), 12.0 * u)
    return np.vstack([pillars, np.stack([x, y], -1)])


def yard(m: int, rng: np.random.Generator) -> Array:
    """Reflectors (m, 2) anywhere in 40 x 40 m, at least 1 m apart."""
    points = np.zeros((0, 2))
    while len(points) < m:
        p = rng.uniform(-20.0, 20.0, 2)
        if (np.hypot(*(points - p).T) > 1.0).all():
            points = np.vstack([points, p])
    return points


def symmetric(m: int, rng: np.random.Generator) -> Array:
    """Reflectors (m or m - 1, 2) in 40 x 24 m that look the same when turned by half."""
    half = rng.uniform((-20.0, 0.0), (20.0, 12.0), (m // 2, 2))
    return np.vstack([half, -half])


LAYOUTS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    'hall': hall,
    'yard': yard,
    'symmetric': symmetric,
}


@dataclass(frozen=True)
class Case:
    """Detections (k, 2) that were made at ``truth`` (3,), and a map (m, 2), with covariances."""

    truth: Array
    points: Array
    cov: Array
    reflectors: Array
    reflectors_cov: Array


def case_of(layout: str, pose: int, seed: int) -> Case:
    """One pose of a layout; the numbers fix all of it."""
    rng = np.random.default_rng([seed, list(LAYOUTS).index(layout), pose])
    m = FEWEST + pose % (MOST - FEWEST + 1)
    true = LAYOUTS[layout](m, rng)
    low, high = true.min(axis=0), true.max(axis=0)
    truth = np.array([*rng.uniform(low, high), rng.uniform(-np.pi, np.pi)])
    sigma = NOISE * rng.random()
    near = np.hypot(*(true - truth[:2]).T) < REACH
    seen = true[near & (rng.random(len(true)) >= MISSING)]
    num_ghosts = round(GHOSTS / (1.0 - GHOSTS) * len(seen))
    ghosts = rng.uniform(low, high, (50 * num_ghosts, 2))
    ghosts = ghosts[np.hypot(*(ghosts - truth[:2]).T) < REACH][:num_ghosts]
    z = se2.transform(se2.inverse(truth), np.vstack([seen, ghosts]))
    z = rng.permutation(z + sigma * rng.standard_normal(z.shape))
    return Case(
        truth,
        z,
        np.tile(sigma**2 * np.eye(2), (len(z), 1, 1)),
        true + MAP_NOISE * rng.standard_normal(true.shape),
        np.tile(MAP_NOISE**2 * np.eye(2), (len(true), 1, 1)),
    )


def is_right(pose: Array, truth: Array) -> bool:
    """Whether a pose is the true one, up to noise."""
    error = se2.between(truth, pose)
    return bool(np.hypot(error[0], error[1]) < RIGHT[0] and abs(error[2]) < RIGHT[1])


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study relocalization``."""
    parser = subparsers.add_parser(
        'relocalization',
        help='whether reflectors alone give the pose, and whether the answer is right',
    )
    parser.add_argument('--poses', type=int, default=1000, metavar='N', help='per layout')
    parser.add_argument('--seed', type=int, default=0, metavar='N', help='default: %(default)s')
    parser.add_argument(
        '--max-range', type=float, default=0.0, metavar='M',
        help=f'count reflectors nearer than this as unseen, up to {REACH:g} (default: none)',
    )  # fmt: skip
    add_workers(parser)
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Evaluate every layout, and maps of other layouts, and print a row for each."""
    workers = workers_of(args)
    if args.poses < 1:
        raise ParameterError('study relocalization: --poses must be 1 or more')
    params = replace(Relocalization(), max_range=args.max_range)
    tasks = [
        (layout, foreign, args.poses, args.seed, params)
        for foreign in (False, True)
        for layout in LAYOUTS
    ]
    rows: dict[str, dict[str, float | None]] = {}
    with Progress('layouts', len(tasks), args.json) as progress:
        for n, (task, figures) in enumerate(each(evaluate, tasks, workers), 1):
            rows[f'{task[0]}, map of another' if task[1] else task[0]] = figures
            progress.update(n, task[0])
    print(json.dumps({'poses': args.poses, 'layouts': rows}) if args.json else text(rows))
    return 0


def evaluate(
    layout: str, foreign: bool, poses: int, seed: int, params: Relocalization
) -> dict[str, float | None]:
    """Figures of one layout; ``foreign``: with the map of another pose's layout, None is right."""
    warm_up()
    results: list[tuple[Case, Constellation, float]] = []
    for pose in range(poses):
        case = case_of(layout, pose, seed)
        other = case_of(layout, pose, seed + 1) if foreign else case
        began = time.perf_counter()
        found = locate(case.points, case.cov, other.reflectors, other.reflectors_cov, params)
        results.append((case, found, 1e3 * (time.perf_counter() - began)))
    of = {v: [(c, f) for c, f, _ in results if f.verdict is v] for v in Verdict}
    unique = [(c.truth, f.candidates[0]) for c, f in of[Verdict.UNIQUE]]
    right = [(T, best) for T, best in unique if not foreign and is_right(best.pose, T)]
    shown = [
        not foreign and any(is_right(candidate.pose, c.truth) for candidate in f.candidates)
        for c, f in of[Verdict.AMBIGUOUS]
    ]
    errors = np.array([best.pose - T for T, best in right]).reshape(-1, 3)
    errors[:, 2] = se2.wrap(errors[:, 2])
    nees = [e @ np.linalg.solve(best.cov, e) for e, (_, best) in zip(errors, right, strict=True)]
    ms = np.array([t for _, _, t in results])
    largest = ms[[len(c.reflectors) >= MOST for c, _, _ in results]]
    return {
        **{v.value: len(of[v]) / poses for v in Verdict},
        'right_of_unique': len(right) / len(unique) if unique else None,
        'truth_of_ambiguous': sum(shown) / len(shown) if shown else None,
        'ambiguous_with_truth': sum(shown) / poses,
        'error_m': float(np.median(np.hypot(errors[:, 0], errors[:, 1]))) if right else None,
        'nees': float(np.mean(nees)) if right else None,
        'median_ms': float(np.median(ms)),
        'p99_ms': float(np.quantile(ms, 0.99)),
        'largest_p99_ms': float(np.quantile(largest, 0.99)) if len(largest) else None,
    }


def text(rows: Mapping[str, Mapping[str, float | None]]) -> str:
    """The table as text."""
    cells = [['layout', *(heading for heading, _ in COLUMNS.values())]]
    for name, figures in rows.items():
        values = [(figures[key], form) for key, (_, form) in COLUMNS.items()]
        cells.append([name, *('-' if v is None else f'{v:{form}}' for v, form in values)])
    return aligned(cells)
