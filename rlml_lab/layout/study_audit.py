# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study audit``: whether an audit finds and names what is wrong with reflectors.

Each drive localizes in the map of the world as planned, while one reflector stands elsewhere, one
is hidden, one is dirty and one is mirrored in a wall; and once with nothing wrong.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rlml_lab.faults import reflector_faults as faults
from rlml_lab.support.drives import feed
from rlml_lab.support.parallel_jobs import each
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.audit.audit import Audit, make_audit
from rlml_slam.planning.audit.findings import Finding, Kind
from rlml_slam.planning.audit.sightings import STEP, SightingLog
from rlml_slam.planning.plan import Goal, figures, make_plan
from rlml_slam.planning.site import Site
from rlml_slam.planning.visibility import visible
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import GroundTruth, Message, Simulation
from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam

OFTEN = 40  # places along the drive from which a faulty reflector, or its image, is in view
LONG = 4.0  # [m] of a wall that is a mirror
RIGHT = 0.025  # [m] a displacement is found if it is this near to the true one
ON_WALL = 0.25  # [m] both ends of the wall that is named are this near to the mirror
NAMED = (Kind.MOVED, Kind.HIDDEN, Kind.DIRTY, Kind.MIRROR)


@dataclass(frozen=True)
class Faults:
    """Reflectors (rows) with a fault each; ``wall`` (2, 2) mirrors the last one."""

    moved: int
    offset: Array
    hidden: int
    dirty: int
    mirrored: int
    wall: Array


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study audit``."""
    parser = subparsers.add_parser(
        'audit', help='whether an audit finds moved, hidden, dirty and mirrored reflectors'
    )
    parser.add_argument('--drives', type=int, default=30, metavar='N', help='of each kind')
    parser.add_argument('--world', default='hall', help='default: %(default)s')
    parser.add_argument('--seed', type=int, default=0, metavar='N', help='of the first drive')
    parser.add_argument('--moved', type=float, default=0.05, help='by how much [m]')
    parser.add_argument('--dirty', type=float, default=0.5, help='share of its sightings missing')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Drive, audit, count; exit code 1 if the figures are worse than they have to be."""
    if args.drives < 1 or args.jobs < 1:
        raise ParameterError('study audit: --drives and --jobs must be 1 or more')
    tasks = [(args.world, args.seed + k, args.moved, args.dirty) for k in range(args.drives)]
    results: list[dict[str, Any]] = []
    with Progress('drives', len(tasks), args.json) as progress:
        for task, result in each(drive, tasks, args.jobs):
            results.append(result)
            progress.update(len(results), f'seed {task[1]}')
    results.sort(key=lambda r: int(r['seed']))
    named = Counter(kind for r in results for kind in r['named'])
    false = sum(len(r['false']) for r in results)
    also = sum(len(r['also']) for r in results)
    found = {'drives': args.drives, 'named': {k.value: named[k.value] for k in NAMED},
             'false_alarms': false, 'others': also, 'each': results}  # fmt: skip
    if args.json:
        print(json.dumps(found))
    else:
        rows = [('fault', 'found and named'), *((k, f'{v} of {args.drives}')
                for k, v in found['named'].items())]  # fmt: skip
        print(aligned(rows))
        print(f'{false} false alarms in {args.drives} drives without a fault; {also} findings of '
              f'other things in {args.drives} drives with faults')  # fmt: skip
        for r in results:
            for what in r['false'] + r['also'] + [f'{k} not named' for k in r['missed']]:
                print(f'seed {r["seed"]}: {what}')
    good = min(found['named'].values()) >= 28 / 30 * args.drives and false <= args.drives / 10
    return 0 if good else 1


def drive(name: str, seed: int, distance: float, share: float) -> dict[str, Any]:
    """One drive without and one with faults; what was found."""
    world, n = load_world(name), SimulatorParameters()
    n = replace(n, markers=replace(n.markers, ids=True))
    site, p = sites.of_world(world), Parameters()
    clean = list(simulate(world, n, seed))
    lasers = laser_path(clean, n)
    f = choose(world, site, lasers, n, distance, seed)
    faulty = simulate(faults.hidden(faults.moved(world, f.moved, f.offset), f.hidden), n, seed)
    ids = world.reflectors.ids
    faulty = faults.dirty(faulty, int(ids[f.dirty]), share, seed)
    laser = np.array(n.node.laser_pose)
    point = world.reflectors.points[f.mirrored]
    faulty = faults.mirrored(faulty, point, f.wall, laser, n.markers, seed)
    plan = figures(make_plan(site, sites.on_path(lasers, 0.5)[:, :2], p, n, Goal(0.05, 1.0, 0)))
    false = audit(world, site, clean, plan, n).findings
    found = audit(world, site, faulty, plan, n).findings
    named = {k.value for k in NAMED if any(is_named(g, f, k) for g in found)}
    also = [g.what for g in found if not any(is_named(g, f, k) for k in NAMED)]
    missed = [k.value for k in NAMED if k.value not in named]
    return {'seed': seed, 'named': sorted(named), 'missed': missed,
            'false': [g.what for g in false], 'also': also}  # fmt: skip


def simulate(world: World, n: SimulatorParameters, seed: int) -> list[Message]:
    """All messages of one drive in order of arrival."""
    return [event.message for event in Simulation(world, n, seed)]


def laser_path(messages: Sequence[Message], n: SimulatorParameters) -> Array:
    """True poses (k, 3) of the laser in the world, one per STEP of travel."""
    true = np.array([m.T_world_base for m in messages if isinstance(m, GroundTruth)])
    return sites.on_path(se2.compose(true, np.array(n.node.laser_pose)), STEP)


def choose(
    world: World, site: Site, lasers: Array, n: SimulatorParameters, distance: float, seed: int
) -> Faults:
    """Reflectors that are in view often enough, each with another fault."""
    rng = np.random.default_rng([seed, 3])
    often = visible(site, lasers[:, :2], Parameters(), n).sum(axis=0) >= OFTEN
    a, b, c = rng.permutation(np.flatnonzero(often))[:3].tolist()
    images = [(k, wall) for k in range(len(often)) for wall in walls(world)
              if k not in (a, b, c)
              and is_imaged(world.reflectors.points[k], wall, lasers, n)]  # fmt: skip
    k, wall = images[rng.integers(len(images))]
    turn = rng.uniform(0.0, 2.0 * np.pi)
    return Faults(a, distance * np.array([np.cos(turn), np.sin(turn)]), b, c, k, wall)


def walls(world: World) -> list[Array]:
    """Long walls, as ends (2, 2)."""
    ends = world.static.segments[:, :4].reshape(-1, 2, 2)
    return [w for w in ends if np.hypot(*(w[1] - w[0])) >= LONG]


def is_imaged(point: Array, wall: Array, lasers: Array, n: SimulatorParameters) -> bool:
    """Whether the image of a reflector in a wall is in view often enough."""
    u = (wall[1] - wall[0]) / np.hypot(*(wall[1] - wall[0]))
    v = np.array([-u[1], u[0]])
    depth, gap = (point - wall[0]) @ v, (lasers[:, :2] - wall[0]) @ v
    image = point - 2.0 * depth * v
    if abs(depth) < 0.3:
        return False
    at = lasers[:, :2] + (gap / (gap + depth))[:, None] * (image - lasers[:, :2])
    along = (at - wall[0]) @ u
    seen = (gap * depth > 0.0) & (along > 0.0) & (along < np.hypot(*(wall[1] - wall[0])))
    seen &= np.hypot(*(image - lasers[:, :2]).T) < n.markers.max_range
    return bool(seen.sum() >= OFTEN)


def audit(
    world: World, site: Site, messages: Sequence[Message], plan: Any, n: SimulatorParameters
) -> Audit:
    """Localize in the map as planned, and audit."""
    p = Parameters()
    node = replace(p.node, mode='localization', map_start_pose=tuple(world.start.tolist()))
    slam, log = Slam(replace(p, node=node)), SightingLog()
    slam.set_sensor_pose(n.node.laser_frame, np.array(n.node.laser_pose))
    slam.use_map(SavedMap(sites.known(site), site.grid))
    sent = [m for m in faults.anonymous(messages) if not isinstance(m, GroundTruth)]
    for frames in feed(slam, sent):
        for frame in frames:
            log.add(frame)
    s = log.sightings(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    return make_audit(site, s, plan, p, n, 0.005)


def is_named(g: Finding, f: Faults, kind: Kind) -> bool:
    """Whether a finding is what was done."""
    if g.kind is not kind:
        return False
    if kind is Kind.MIRROR:
        u = (f.wall[1] - f.wall[0]) / np.hypot(*(f.wall[1] - f.wall[0]))
        off = np.abs((g.wall - f.wall[0]) @ np.array([-u[1], u[0]]))
        return g.subject == f.mirrored and bool((off < ON_WALL).all())
    if kind is Kind.MOVED:
        return g.subject == f.moved and float(np.hypot(*(g.shift - f.offset))) < RIGHT
    return g.subject == {Kind.HIDDEN: f.hidden, Kind.DIRTY: f.dirty}[kind]
