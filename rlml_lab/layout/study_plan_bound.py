# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study plan-bound``: whether the planned sigma is the error that is made.

A drive gives detections with noise, misses and ghosts. Each scan alone gives a pose: the front
end's reflector update, linearized at the true pose, with a prior so wide that it says nothing. Its
error is compared with the sigma that is planned for the true place, in the direction that is worst
by the plan. A plan is of the still world: the drives that count are without people. Worlds with
people are driven with them too, for the figures beside.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.support.parallel_jobs import each
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.bound import bound
from rlml_slam.planning.driving import schur
from rlml_slam.planning.plan import square_size
from rlml_slam.planning.visibility import visible
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.reflector_update import use_reflectors
from rlml_slam.types import ANONYMOUS, Detections

FOLDER = Path(__file__).parent
WORLDS = ('hall', 'corridor', 'yard', 'symmetric', str(FOLDER / 'l_hall.yaml'),
          str(FOLDER / 'ring.yaml'), 'room')  # fmt: skip
GOOD, LOW, HIGH = 0.03, 0.8, 1.25  # [m] planned sigma up to which the ratio has to be within these
FEW = 30  # scans below which an area says nothing
WIDE = np.diag([100.0, 100.0, 1.0])  # prior [m², m², rad²]
BEAMS = 72  # the scan is not used


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study plan-bound``."""
    parser = subparsers.add_parser(
        'plan-bound', help='errors of the reflector term against the planned sigma, area by area'
    )
    parser.add_argument('--seeds', type=int, default=20, metavar='N', help='drives per world')
    parser.add_argument('--world', action='append', metavar='NAME', help='default: all')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Drive and compare; exit code 1 if a ratio without people is not within LOW and HIGH."""
    if args.seeds < 1 or args.jobs < 1:
        raise ParameterError('study plan-bound: --seeds and --jobs must be 1 or more')
    tasks = [(name, args.seeds, people) for name in args.world or WORLDS
             for people in ((False, True) if load_world(name).movers else (False,))]  # fmt: skip
    rows: list[dict[str, Any]] = []
    with Progress('worlds', len(tasks), args.json) as progress:
        for n, (task, found) in enumerate(each(areas, tasks, args.jobs), 1):
            rows += found
            progress.update(n, Path(task[0]).stem)
    tested = [r for r in rows if r['planned_m'] < GOOD and r['scans'] >= FEW]
    counts = {}
    for people in (False, True):
        ratios = [r['ratio'] for r in tested if r['people'] is people]
        counts[people] = len(ratios), sum(LOW <= ratio <= HIGH for ratio in ratios)
    if args.json:
        print(json.dumps({
            'seeds': args.seeds, 'tested': counts[False][0], 'good': counts[False][1],
            'tested_with_people': counts[True][0], 'good_with_people': counts[True][1],
            'areas': rows,
        }))  # fmt: skip
    else:
        print(text(rows))
        for people, (count, good) in counts.items():
            print(f'{"with" if people else "without"} people: {good} of {count} areas planned '
                  f'below {GOOD} m are within {LOW} and {HIGH}')  # fmt: skip
    return 0 if counts[False][0] == counts[False][1] else 1


def areas(world: str, seeds: int, people: bool) -> list[dict[str, Any]]:
    """A row for each area of a world, over all seeds."""
    found = [drive(world, seed, people) for seed in range(seeds)]
    places, error, planned, view, seen = (np.concatenate(v) for v in zip(*found, strict=True))
    size = square_size(places)
    low = np.floor(places.min(axis=0) / size)
    cell = (np.floor(places / size) - low).astype(int)
    rows = []
    for j, i in np.unique(cell, axis=0).tolist():
        mine = (cell == (j, i)).all(axis=1) & np.isfinite(planned)
        if not mine.any():
            continue
        rms, sigma = (float(np.sqrt(np.mean(v[mine] ** 2))) for v in (error, planned))
        rows.append({
            'world': Path(world).stem, 'people': people, 'area': f'{chr(65 + j)}{i + 1}',
            'scans': int(mine.sum()), 'in_view': float(view[mine].mean()),
            'seen': float(seen[mine].mean()), 'planned_m': sigma, 'rms_m': rms,
            'ratio': rms / sigma,
        })  # fmt: skip
    return rows


def drive(name: str, seed: int, people: bool) -> tuple[Array, ...]:
    """Of each scan: place (n, 2), error and planned sigma [m], reflectors in view and seen."""
    n, p = SimulatorParameters(), Parameters()
    world = load_world(name)
    world = world if people else world.without_movers()
    site = sites.of_world(world)
    coarse = replace(n, laser=replace(n.laser, beams=BEAMS),
                     markers=replace(n.markers, ids=True))  # fmt: skip
    messages = [event.message for event in Simulation(world, coarse, seed)]
    true = {m.stamp: m.T_world_base for m in messages if isinstance(m, GroundTruth)}
    laser = np.array(n.node.laser_pose)
    scans = [(se2.compose(true[m.stamp], laser), m) for m in messages
             if isinstance(m, Detections) and m.stamp in true]  # fmt: skip
    places = np.array([pose[:2] for pose, _ in scans])
    view = visible(site, places, p, n)
    planned = bound(places, view, site.reflectors.points, site.cov, p.reflector)
    a, b, c = schur(planned.information)
    worst = 0.5 * np.arctan2(-2.0 * b, c - a)  # direction of the least information
    errors, seen = [], []
    for (pose, detections), angle in zip(scans, worst, strict=True):
        error, count = estimate(pose, detections, site.reflectors.points, world.reflectors.ids, p)
        errors.append(error[:2] @ [np.cos(angle), np.sin(angle)])
        seen.append(count)
    held = np.isfinite(planned.position) & (np.array(seen) >= 2)
    return (
        places[held], np.array(errors)[held], planned.position[held],
        view.sum(axis=1)[held].astype(float), np.array(seen)[held].astype(float),
    )  # fmt: skip


def estimate(
    pose: Array, d: Detections, points: Array, ids: Iterable[int], p: Parameters
) -> tuple[Array, int]:
    """Error (3,) of the pose of one scan by the front end's reflector update, and its matches."""
    known = np.flatnonzero(d.ids != ANONYMOUS)
    row = {int(i): k for k, i in enumerate(ids)}
    at = np.array([row[int(i)] for i in d.ids[known]], dtype=np.int64)
    state = JointState(pose, WIDE, 0.1)
    state.fix_landmarks(points[at], np.zeros((len(at), 2, 2)))
    if len(at):
        none = np.zeros(len(at))
        use_reflectors(
            state.x, state.P, np.arange(len(at)), d.points[known].copy(), d.cov[known].copy(),
            none, none, p.reflector.robust_scale,
        )  # fmt: skip
    error = state.x[:3] - pose
    error[2] = se2.wrap(error[2])
    return error, len(at)


def text(rows: Sequence[dict[str, Any]]) -> str:
    """A row for each area."""
    head = ('world', 'people', 'area', 'scans', 'in view', 'seen', 'planned [cm]', 'RMS [cm]',
            'ratio')  # fmt: skip
    lines = [
        (r['world'], 'yes' if r['people'] else 'no', r['area'], str(r['scans']),
         f'{r["in_view"]:.1f}', f'{r["seen"]:.1f}',
         f'{100 * r["planned_m"]:.2f}', f'{100 * r["rms_m"]:.2f}', f'{r["ratio"]:.2f}')
        for r in rows
    ]  # fmt: skip
    return aligned([head, *lines])
