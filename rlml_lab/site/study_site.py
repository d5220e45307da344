# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study site``: many sessions of a large site become one map.

Every session is mapped by itself and saved. ``rlml map merge`` gets the files alone, in an order
of chance: nothing says where a session lies, or that two belong to another site.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.site.large_site import (
    AISLE,
    alignment_errors,
    docks,
    make_route,
    make_site,
    simulation,
    simulator_parameters,
)
from rlml_lab.support.drives import feed
from rlml_slam import se2, warm_up
from rlml_slam.cli.map.map_merge import mapper
from rlml_slam.errors import MapError, ParameterError
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file

ANYWHERE, STRANGERS = 3, 2  # sessions that start anywhere, and that belong to another site
AREA, REFLECTORS = 1000.0, 10  # [m²] and reflectors of the site per session
PLACED = np.array([0.5, 0.5, 0.05])  # [m, m, rad] a session farther from the truth is wrong
COLUMNS = {
    'sessions': 'd', 'area_m2': '.0f', 'placed': 'd', 'wrong': 'd', 'strangers_left_out': 'd',
    'reflectors': 'd', 'found': 'd', 'spurious': 'd', 'rms_mm': '.1f', 'largest_mm': '.1f',
    'map_s': '.0f', 'merge_s': '.1f', 'merge_mb': '.0f', 'file_mb': '.1f',
}  # fmt: skip


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study site``."""
    parser = subparsers.add_parser(
        'site',
        help='many sessions of a large site become one map',
        description='Maps the sessions of simulated sites, 1000 m² and 10 reflectors for each '
        'session, of which 3 start anywhere and 2 belong to another site, and merges them.',
    )
    parser.add_argument(
        '--sessions', type=int, nargs='+', default=[10, 20, 40], help='default: 10 20 40'
    )
    parser.add_argument(
        '--length', type=float, default=300.0, help='of a drive [m] (default: %(default)s)'
    )
    parser.add_argument(
        '--scans', type=float, default=4.0, help='per second (default: %(default)s)'
    )
    parser.add_argument('--seed', type=int, default=0, help='default: %(default)s')
    parser.add_argument('--jobs', type=int, default=1, help='processes (default: %(default)s)')
    parser.add_argument('--cluster', help='scheduler of Dask')
    parser.add_argument('--out', type=Path, help='keep the maps here, and use those that are')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Map, merge and print a row per number of sessions."""
    if min(args.sessions) < ANYWHERE + STRANGERS + 1:
        raise ParameterError('study site: --sessions must be 6 or more')
    if not 1.0 <= args.scans <= 40.0:
        raise ParameterError('study site: --scans must be 1 to 40')
    warm_up.compile_loaded()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for number in args.sessions:
            folder = (args.out or Path(scratch)) / f'{number}-sessions'
            rows.append(study(number, args, folder))
    if args.json:
        print(json.dumps(rows))
    else:
        print(table(rows))
    return 0


def study(number: int, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Figures of one site."""
    begin = time.perf_counter()
    with mapper(args.cluster, args.jobs) as workers:
        n = [number] * number
        starts = workers(
            map_session, range(number), n, [args.length] * number, [args.scans] * number,
            [args.seed] * number, [folder] * number,
        )  # fmt: skip
    mapped = time.perf_counter() - begin
    order = np.random.default_rng(args.seed).permutation(number)
    files = [name_of(folder, k) for k in order]
    engine = ['--jobs', str(args.jobs), *(['--cluster', args.cluster] if args.cluster else [])]
    merged, seconds = merge(files, folder / 'site.rlml', engine)
    truth = make(number, args.seed)[0].reflectors
    return {
        'sessions': number, 'area_m2': AREA * number, 'reflectors': len(truth),
        'map_s': mapped, 'merge_s': seconds, 'merge_mb': merged['peak_rss_mb'],
        **evaluate(merged, folder, np.array(starts), truth),
        'left_out': {Path(f).stem: why for f, why in merged['left_out'].items()},
    }  # fmt: skip


def make(number: int, seed: int) -> Any:
    """The site and another one."""
    side = AISLE * round(np.sqrt(AREA * number) / AISLE)
    return [
        make_site(side, REFLECTORS * number, np.random.default_rng([seed, number, which]))
        for which in range(2)
    ]


def name_of(folder: Path, k: int) -> Path:
    """File of the k-th session."""
    return folder / f'session-{k:02d}.rlml'


def map_session(
    k: int, number: int, length: float, scans: float, seed: int, folder: Path
) -> Array:  # fmt: skip
    """Drive and map one session, and save it; its true first pose (3,) in the site.

    A session that is in the folder already is not driven again.
    """
    path = name_of(folder, k)
    asked = {'sessions': number, 'length': length, 'scans': scans, 'seed': seed}
    with contextlib.suppress(OSError, ValueError):  # none, or cut short
        known = json.loads(path.with_suffix('.json').read_text())
        if asked.items() <= known.items() and path.exists():
            return np.array(known['T_world_map'])
    sites = make(number, seed)
    site = sites[k >= number - STRANGERS]
    rng = np.random.default_rng([seed, number, 2, k])
    places = docks(site.side)
    start = places[k % len(places)]
    if k < ANYWHERE:
        start = AISLE * rng.integers(0, round(site.side / AISLE) + 1, 2)
    drive = simulation(site, make_route(site.side, start, length, rng), seed + k, scans)
    slam = Slam(Parameters())
    node = simulator_parameters(scans).node
    slam.set_sensor_pose(node.laser_frame, np.array(node.laser_pose))
    feed(slam, [event.message for event in drive])
    map_file.save(path, slam.back_end, Parameters())
    known = asked | {'T_world_map': drive.T_world_map.tolist()}
    path.with_suffix('.json').write_text(json.dumps(known))
    return drive.T_world_map


def merge(files: Sequence[Path], out: Path, engine: Sequence[str]) -> tuple[dict[str, Any], float]:
    """Run ``rlml map merge`` as a process: what it printed, and its time [s]."""
    begin = time.perf_counter()
    command = [sys.executable, '-m', 'rlml_slam', 'map', 'merge', *map(str, files)]
    command += ['--out', str(out), '--json', *engine]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise MapError(f'rlml map merge ended with {done.returncode}')
    return json.loads(done.stdout), time.perf_counter() - begin


def evaluate(
    merged: dict[str, Any], folder: Path, starts: Array, truth: Array
) -> dict[str, Any]:  # fmt: skip
    """Errors of the merged map; ``starts`` (n, 3) are the true first poses of the sessions."""
    number = len(starts)
    numbers = [int(Path(s['map']).stem.split('-')[1]) for s in merged['sessions']]
    poses = np.array([s['T_map_session'] for s in merged['sessions']])
    found = map_file.saved_map(map_file.load(folder / 'site.rlml')).reflectors
    T = starts[numbers[0]]  # the frame of the map is that of its first session
    off = np.abs(se2.between(starts[numbers], se2.compose(T, poses)))
    error, rows = alignment_errors(se2.transform(T, found.points), truth)
    good = error < 0.5
    misplaced = np.asarray((off > PLACED).any(axis=1))
    strangers = {k for k in range(number) if k >= number - STRANGERS}
    return {
        'placed': len(numbers),
        'wrong': int((misplaced | np.isin(numbers, list(strangers))).sum()),
        'strangers_left_out': len(strangers - {*numbers}),
        'found': len(rows),
        'spurious': int((~good).sum()),
        'rms_mm': 1e3 * float(np.sqrt(np.mean(error[good] ** 2))),
        'largest_mm': 1e3 * float(error[good].max()),
        'keyframes': merged['keyframes'],
        'file_mb': (folder / 'site.rlml').stat().st_size / 1e6,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A row per number of sessions, and who was left out."""
    cells = [
        list(COLUMNS),
        *([f'{r[name]:{form}}' for name, form in COLUMNS.items()] for r in rows),
    ]
    widths = [max(len(row[k]) for row in cells) for k in range(len(COLUMNS))]
    lines = ['  '.join(f'{c:>{w}}' for c, w in zip(row, widths, strict=True)) for row in cells]
    for r in rows:
        lines += [
            f'{r["sessions"]}: {name} left out: {why}' for name, why in r['left_out'].items()
        ]
    return '\n'.join(lines)
