# SPDX-License-Identifier: Apache-2.0
"""``study fleet``: whether a fleet's replays are the same, fast, safe and sharp on a cluster."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlml_lab.fleet.results import Record, Results
from rlml_lab.fleet.run import replay_all, write_tables
from rlml_lab.fleet_studies import by_processes, regressions, stores
from rlml_lab.fleet_studies.fleet_bags import Fleet, make_bag
from rlml_lab.support.cluster import open_client
from rlml_lab.support.parallel_jobs import each_by
from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import ParameterError

ROUNDS = 4  # in which one worker and two take turns, so that other load costs both alike
MIN_SPEED_UP, MAX_OVERHEAD_S = 1.8, 0.05
PARTS = ('speed', 'processes', 'kills', 'regressions', 'stores')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study fleet``."""
    parser = subparsers.add_parser(
        'fleet',
        help='many replays on a cluster: the same, faster, through kills, and what they find',
        description='Bags of four worlds, with faults, on one worker and on two, by processes '
        'started by hand, through kills, with planted regressions, and in other stores.',
    )
    parser.add_argument('--bags', type=int, default=200, metavar='N', help='default: %(default)s')
    parser.add_argument('--seconds', type=float, default=8.0, help='of each drive (default: 8)')
    parser.add_argument('--reruns', type=int, default=50, metavar='N', help='without a change')
    parser.add_argument('--only', nargs='+', choices=PARTS, default=list(PARTS), metavar='PART')
    parser.add_argument('--out', type=Path, metavar='DIR', help='default: a folder that goes')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run the parts; 1 where something is not as it must be."""
    if args.bags < 20 or not 2.0 <= args.seconds <= 600.0 or args.reruns < 1:
        raise ParameterError('study fleet: --bags from 20, --seconds from 2 to 600, --reruns > 0')
    with tempfile.TemporaryDirectory() as scratch:
        out = (args.out or Path(scratch)).resolve()
        fleet = Fleet(out / 'bags', out, args.seconds, args.reruns)
        simulate(fleet, args.bags, args.json)
        parts: dict[str, Callable[[Fleet], dict[str, Any]]] = {
            'speed': speed, 'processes': by_processes.by_hand, 'kills': by_processes.kills,
            'regressions': regressions.planted, 'stores': stores.stores,
        }  # fmt: skip
        figures: dict[str, Any] = {}
        for part in args.only:
            began, load = time.perf_counter(), os.getloadavg()[0]
            figures[part] = parts[part](fleet)
            figures[part] |= {
                'part_s': round(time.perf_counter() - began, 1), 'load_before': load,
            }  # fmt: skip
            if not args.json:
                print(part, json.dumps(figures[part]), flush=True)
    if args.json:
        print(json.dumps(figures))
    return 0 if all(f.get('holds', True) for f in figures.values()) else 1


def simulate(fleet: Fleet, n: int, quiet: bool) -> None:
    """Write the bags that are not there yet."""
    tasks = [(str(fleet.bags), k, fleet.seconds) for k in range(n)]
    with open_client(None) as client, Progress('simulate', n, quiet) as bar:
        for k, _ in enumerate(each_by(client, make_bag, tasks), 1):
            bar.update(k)


def speed(fleet: Fleet) -> dict[str, Any]:
    """One worker against two, in turns; the table of both, and what the engine costs per bag."""
    wall, records = {1: 0.0, 2: 0.0}, dict[int, list[Record]]({1: [], 2: []})
    with open_client(None, 1) as one, open_client(None, 2) as two:
        clients = {1: one, 2: two}
        for n, client in clients.items():  # kernels and libraries are loaded first
            warm = fleet.jobs(fleet.out / 'warm')[: 4 * n]
            replay_all(client, warm, lambda done, note: None)
        for r in range(ROUNDS):
            for n, client in clients.items():
                jobs = fleet.jobs(fleet.out / f'workers_{n}')[r::ROUNDS]
                began = time.perf_counter()
                records[n] += replay_all(client, jobs, lambda done, note: None)
                wall[n] += time.perf_counter() - began
    for n, found in records.items():
        found.sort(key=lambda r: r.name)
        write_tables(Results(str(fleet.out / f'workers_{n}')), found)
    bags = len(records[1])
    inside = sum(r.times['replay_s'] + r.times['write_s'] for r in records[1])
    speed_up, overhead = wall[1] / wall[2], (wall[1] - inside) / bags
    same = fleet.table('workers_1') == fleet.table('workers_2')
    cpu = {n: sum(r.times['cpu_s'] for r in found) for n, found in records.items()}
    spent = sum(r.times['fetch_s'] + r.times['replay_s'] + r.times['write_s'] for r in records[2])
    hours = sum(r.row['duration_s'] for r in records[1]) / 3600.0
    return {
        'bags': bags, 'one_s': round(wall[1], 1), 'two_s': round(wall[2], 1),
        'speed_up': round(speed_up, 3), 'overhead_ms_per_bag': round(1e3 * overhead, 1),
        'same_table': same, 'core_s_per_hour_of_driving': round(cpu[1] / hours, 1),
        # what two free cores would give: share of the time that two workers work, cost of a bag
        'two_busy': round(spent / (2.0 * wall[2]), 3), 'cpu_ratio': round(cpu[2] / cpu[1], 3),
        'memory_mb': max(r.times['memory_mb'] for r in records[1]),
        'holds': same and speed_up >= MIN_SPEED_UP and overhead <= MAX_OVERHEAD_S,
    }  # fmt: skip
