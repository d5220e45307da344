# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study plan-verdicts``: whether a place that is planned unique is answered right.

At each place a standing robot is simulated: one scan of detections with noise, misses, ghosts and
what passes by. Relocalization searches in the whole layout; its answer is compared with the true
pose, and its verdict with the planned one.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.layout.study_plan_bound import BEAMS, WORLDS
from rlml_lab.studies.study_relocalization import is_right
from rlml_lab.support.parallel_jobs import each
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.matching.reflectors.constellation import Constellation, locate
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.samples import rival
from rlml_slam.planning.site import Site
from rlml_slam.planning.visibility import visible
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Detections, Verdict

LAYOUTS = WORLDS[:6]
SPACING, CLEARANCE = 0.1, 0.3  # [m] of the places that are drawn from
COLUMNS = ('places', 'planned_unique', 'unique', 'agree', 'wrong', 'wrong_of_planned')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study plan-verdicts``."""
    parser = subparsers.add_parser(
        'plan-verdicts', help='whether places that are planned unique are answered right'
    )
    parser.add_argument('--places', type=int, default=10_000, metavar='N', help='of all layouts')
    parser.add_argument('--seed', type=int, default=0, metavar='N', help='default: %(default)s')
    parser.add_argument('--missed', type=float, default=0.1, help='share of missed reflectors')
    parser.add_argument('--ghosts', type=float, default=0.3, help='mean number of ghosts')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Search at all places; exit code 1 if a place that is planned unique is answered wrongly."""
    if args.places < len(LAYOUTS) or args.jobs < 1:
        raise ParameterError('study plan-verdicts: --places must be 6 or more, --jobs 1 or more')
    shares = np.diff(np.linspace(0, args.places, len(LAYOUTS) + 1).astype(int)).tolist()
    tasks = [(world, share, args.seed, args.missed, args.ghosts)
             for world, share in zip(LAYOUTS, shares, strict=True)]  # fmt: skip
    rows: dict[str, dict[str, int]] = {}
    with Progress('layouts', len(tasks), args.json) as progress:
        for n, (task, found) in enumerate(each(layout, tasks, args.jobs), 1):
            rows[Path(task[0]).stem] = found
            progress.update(n, Path(task[0]).stem)
    rows['all'] = {k: sum(r[k] for r in rows.values()) for k in COLUMNS}
    if args.json:
        print(json.dumps(rows))
    else:
        table = [(k, *(str(r[c]) for c in COLUMNS)) for k, r in rows.items()]
        print(aligned([('layout', *(c.replace('_', ' ') for c in COLUMNS)), *table]))
        print(f'{rows["all"]["agree"] / rows["all"]["places"]:.1%} of the verdicts are as planned')
    return 1 if rows['all']['wrong_of_planned'] else 0


def layout(name: str, num: int, seed: int, missed: float, ghosts: float) -> dict[str, int]:
    """Counts of one layout: ``wrong`` are unique answers that are another place."""
    world, p, n = load_world(name), Parameters(), SimulatorParameters()
    n = replace(
        n, laser=replace(n.laser, beams=BEAMS),
        markers=replace(n.markers, missed_share=missed, false_detections=ghosts),
        node=replace(n.node, drive='cmd_vel', duration=0.25, laser_pose=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    site = sites.of_world(world)
    rng = np.random.default_rng([seed, LAYOUTS.index(name)])
    free = sites.places(site, SPACING, CLEARANCE)
    chosen = free[rng.choice(len(free), num, replace=len(free) < num)]
    poses = np.column_stack([chosen, rng.uniform(-np.pi, np.pi, num)])
    view = visible(site, chosen, p, SimulatorParameters())
    counts: Counter[str] = Counter({c: 0 for c in COLUMNS} | {'places': num})
    for k, pose in enumerate(poses):
        planned = rival(site, chosen[k], view[k], p)[0] is Verdict.UNIQUE
        answer = search(world, site, pose, n, p, 10_000 * seed + k)
        unique = answer.verdict is Verdict.UNIQUE
        wrong = unique and not is_right(answer.candidates[0].pose, pose)
        counts.update(planned_unique=planned, unique=unique, agree=planned == unique,
                      wrong=wrong, wrong_of_planned=wrong and planned)  # fmt: skip
    return dict(counts)


def search(
    world: World, site: Site, pose: Array, n: SimulatorParameters, p: Parameters, seed: int
) -> Constellation:
    """The answer of relocalization to the first detections of a robot that stands at ``pose``."""
    drive = Simulation(replace(world, start=pose), n, seed)
    d = next(e.message for e in drive if isinstance(e.message, Detections))
    return locate(d.points, d.cov, site.reflectors.points, site.cov, p.relocalization)
