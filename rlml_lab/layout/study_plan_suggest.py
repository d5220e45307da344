# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study plan-suggest``: whether suggested layouts are near the best, and keep promises.

Small rooms against exhaustive search; the fewest reflectors of the symmetric hall, the corridor
and an empty depot, and drives through them; time for a large hall; rules of thumb.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.layout.layout_cases import depot, large_hall, small_room
from rlml_lab.layout.planned_drive import drive
from rlml_lab.layout.rules_of_thumb import rules
from rlml_lab.support.parallel_jobs import each
from rlml_slam import warm_up
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.coverage import Choice, start
from rlml_slam.planning.mounts import wall_mounts
from rlml_slam.planning.plan import Goal, make_plan
from rlml_slam.planning.suggest import Wanted, coverage, suggest, suggested
from rlml_slam.report.plan_page import write_plan
from rlml_slam.se2 import Array
from rlml_slam.simulation.world_file import load_world

P, SENSOR = Parameters(), SimulatorParameters()
PARTS = ('small', 'layouts', 'speed', 'rules')
FEW = 12  # mounts of a small room
NEAR = 0.05  # of the best
Rows = list[dict[str, Any]]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study plan-suggest``."""
    parser = subparsers.add_parser(
        'plan-suggest',
        help='suggested reflectors against exhaustive search, and drives through layouts',
    )
    parser.add_argument('--only', nargs='+', choices=PARTS, default=list(PARTS), metavar='PART',
                        help=f'of {", ".join(PARTS)}')  # fmt: skip
    parser.add_argument('--cases', type=int, default=50, metavar='N', help='small rooms')
    parser.add_argument('--seeds', type=int, default=5, metavar='N', help='drives of a layout')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run the parts and print a table of each; 1 where a suggestion misses what it promises."""
    if args.cases < 1 or args.seeds < 1 or args.jobs < 1:
        raise ParameterError('study plan-suggest: --cases, --seeds and --jobs must be 1 or more')
    warm_up.compile_loaded()
    found: dict[str, Rows] = {}
    if 'small' in args.only:
        tasks = [(k,) for k in range(args.cases)]
        found['small'] = sorted((row for _, row in each(small, tasks, args.jobs)),
                                key=lambda row: int(row['seed']))  # fmt: skip
    if 'layouts' in args.only:
        tasks_of = [(name, args.seeds) for name in ('symmetric', 'corridor', 'depot')]
        found['layouts'] = [row for _, row in each(layout, tasks_of, args.jobs)]
    if 'speed' in args.only:
        found['speed'] = speed()
    if 'rules' in args.only:
        found['rules'] = rules()
    print(json.dumps(found) if args.json else '\n\n'.join(text(k, v) for k, v in found.items()))
    missed = [r for rows in found.values() for r in rows if r.get('kept') is False]
    return 1 if missed else 0


def small(seed: int) -> dict[str, Any]:
    """A room: three more (accuracy) or two more (odd seeds, and unique), and the fewest."""
    site = sites.of_world(small_room(seed))
    places = sites.places(site, 1.0, 0.3)
    mounts = _few(wall_mounts(site, 1.0, 0.3))
    is_unique, none = seed % 2 == 1, np.zeros((0, 2))
    wanted = Wanted(2 if is_unique else 3, Goal(0.011), is_unique=is_unique)
    of = coverage(site, mounts, places, P, SENSOR, wanted, none)
    empty = start(of)
    chosen = [_index(empty, mount) for mount in suggest(of, wanted).mounts]
    number = wanted.number or 0
    best = min(_loss(empty, c) for c in combinations(range(len(mounts)), number))
    share = _share(empty.loss - _loss(empty, chosen), empty.loss - best)
    fewest = replace(wanted, number=None, is_unique=False)
    of = coverage(site, mounts, places, P, SENSOR, fewest, none)
    found = suggest(of, fewest)
    least = _fewest(start(of)) if found.is_complete else None
    count = len(found.mounts) if found.is_complete else None
    is_least = count is None or least is None or count <= (1.0 + NEAR) * least
    return {'seed': seed, 'unique': is_unique, 'places': len(places), 'mounts': len(mounts),
            'share_of_best': share, 'fewest': count, 'fewest_of_all': least,
            'kept': share >= 1.0 - NEAR and is_least}  # fmt: skip


def _few(mounts: Array) -> Array:
    return mounts[np.unique(np.linspace(0, len(mounts) - 1, FEW).round().astype(int))]


def _index(empty: Choice, mount: Array) -> int:
    points = empty.of.points[empty.of.num_present :]
    return int(np.argmin(np.hypot(*(points - mount).T)))


def _loss(empty: Choice, mounts: Any) -> float:
    """The loss with some of the mounts."""
    first = empty.of.num_present
    return empty.changed(*(first + k for k in mounts)).loss if len(mounts) else empty.loss


def _share(gain: float, best: float) -> float:
    return 1.0 if best <= 1e-12 else gain / best


def _fewest(empty: Choice) -> int | None:
    """By trying all choices of one, two and so on."""
    of = empty.of
    everywhere, mounts = np.arange(len(of.places)), range(len(of.points) - of.num_present)
    for number in range(len(mounts) + 1):
        for some in combinations(mounts, number):
            chosen = empty.chosen.copy()
            chosen[[of.num_present + k for k in some]] = True
            if not of.costs(everywhere, of.members(chosen, everywhere)).any():
                return number
    return None


def layout(name: str, seeds: int) -> dict[str, Any]:
    """The fewest more of a world, and drives through the layout, localized in it."""
    world = depot() if name == 'depot' else load_world(name)
    site, goal = sites.of_world(world), Goal(0.01)
    places = sites.places(site, 0.25, 0.3)
    if name == 'corridor':
        ends = sites.inside(np.array([[0, -1.2], [60, -1.2], [60, 1.2], [0, 1.2]]), places)
        places = places[ends]
    wanted = Wanted(None, goal, is_accurate=name != 'symmetric', is_unique=name != 'corridor')
    found, plan = suggested(site, wall_mounts(site, 1.0, 0.3), places, P, SENSOR, wanted)
    drives = [drive(world, plan.site, goal, seed) for seed in range(seeds)]
    error = float(np.sqrt(np.mean([d.error**2 for d in drives])))
    planned = float(np.sqrt(np.mean([d.planned**2 for d in drives])))
    reached = plan.is_reached.all() if wanted.is_accurate else plan.is_unique.all()
    return {
        'world': name, 'present': len(site.reflectors), 'added': len(found.mounts),
        'at_least': found.at_least, 'goal_before': found.steps[0].goal_share,
        'unique_before': found.steps[0].unique_share, 'goal_share': float(plan.is_reached.mean()),
        'unique_share': float(plan.is_unique.mean()),
        'planned_max_m': float(plan.driving.position.max()), 'planned_rms_m': planned,
        'error_rms_m': error, 'error_max_m': max(d.error for d in drives),
        'along_rms_m': float(np.sqrt(np.mean([d.along**2 for d in drives]))),
        'stated_m': float(np.mean([d.stated for d in drives])),
        'ok_share': float(np.mean([d.ok_share for d in drives])),
        'kept': found.is_complete and error <= planned and bool(reached),
    }  # fmt: skip


def speed() -> Rows:
    """Processor time for 10 000 m^2 and 100 reflectors: plan, its files, and 20 suggestions."""
    site = sites.of_world(large_hall())
    rows = []

    def timed(name: str, limit: float, step: Callable[[], Any]) -> None:
        began, cpu = time.perf_counter(), time.process_time()
        step()
        cpu = time.process_time() - cpu
        rows.append({'step': name, 'places': len(places), 'cpu_s': cpu,
                     'wall_s': time.perf_counter() - began, 'limit_s': limit,
                     'kept': cpu <= limit})  # fmt: skip

    places = sites.places(site, 0.25, 0.3)
    goal = Goal(0.01)
    timed('plan', 10.0, lambda: make_plan(site, places, P, SENSOR, goal))
    with tempfile.TemporaryDirectory() as out:
        timed('plan with pictures', 10.0, lambda: write_plan(
            make_plan(site, places, P, SENSOR, goal), 'hall', Path(out)))  # fmt: skip
    timed('suggest 20', 60.0, lambda: suggested(
        site, wall_mounts(site, 1.0, 0.3), places, P, SENSOR, Wanted(20, goal)))  # fmt: skip
    return rows


def text(name: str, rows: Rows) -> str:
    """A table of all rows; of small rooms, how many are near the best."""
    cells = [list(rows[0]), *([_cell(v) for v in row.values()] for row in rows)]
    lines = [name, aligned(cells)]
    if name == 'small':
        near = sum(r['share_of_best'] >= 1.0 - NEAR for r in rows)
        counted = [r for r in rows if r['fewest'] is not None]
        least = sum(r['fewest'] == r['fewest_of_all'] for r in counted)
        lines.append(f'{near} of {len(rows)} within {NEAR:.0%} of the best choice; the fewest '
                     f'found in {least} of {len(counted)} that can reach the goal')  # fmt: skip
    return '\n'.join(lines)


def _cell(value: Any) -> str:
    return f'{value:.4f}' if isinstance(value, float) else '' if value is None else str(value)
