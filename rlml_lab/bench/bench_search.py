# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench search``: time and verdicts of searches for a lost robot in a large map.

Scans of a building are searched in its own map, where the pose is known, and in that of another
building, where nothing may be found. A pose that is called unique and is not right is wrong.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from typing import Any

import numpy as np

from rlml_lab.support.office_building import Building
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.scans import branch_and_bound
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.grid_submap import submap_of
from rlml_slam.slam.relocalization.scan_relocalization import Relocation, relocalize
from rlml_slam.types import Verdict

RIGHT = (0.3, 0.1)  # [m], [rad] a pose with less error is the right one
LASERS = ((180, np.pi), (360, np.pi), (720, 2.0 * np.pi))  # beams, view


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench search``."""
    parser = subparsers.add_parser('search', help='global searches by scan in a large building')
    parser.add_argument('--scans', type=int, default=30, metavar='N', help='of each building')
    parser.add_argument(
        '--size', type=float, default=141.0, metavar='M', help='side (default: %(default)s)'
    )
    parser.add_argument('--seed', type=int, default=1, metavar='N', help='default: %(default)s')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Search every scan and print a row for each building."""
    if args.scans < 1 or not args.size >= 10.0:
        raise ParameterError('bench search: --scans must be 1 or more, --size 10 or more')
    branch_and_bound.warm_up()
    building, other = Building(args.seed, args.size), Building(args.seed + 1, args.size)
    grid, params = building.grid(), Parameters()
    began = time.thread_time()
    pyramid = submap_of(grid, params.submap).pyramid
    built = time.thread_time() - began
    rows: dict[str, dict[str, float]] = {}
    with Progress('scans', 2 * args.scans, args.json) as progress:
        for name, source in (('its own', building), ('of another building', other)):
            results = []
            for n, pose in enumerate(source.visits(args.scans)):
                results.append(searched(grid, source, pose, LASERS[n % len(LASERS)], params))
                progress.update(len(rows) * args.scans + n + 1, name)
            rows[name] = figures(results, source is building)
    out = {'area_m2': args.size**2, 'pyramid_s': built, 'pyramid_mb': pyramid.nbytes / 1e6}
    print(json.dumps(out | {'rows': rows}) if args.json else text(out, rows))
    return 0


def searched(
    grid: OccupancyGrid, source: Building, pose: Array, laser: tuple[int, float], p: Parameters
) -> tuple[Array, Relocation, float]:
    """The pose, what was found, and the processor's time [s]."""
    points = source.scan(pose, *laser)
    began = time.thread_time()
    found = relocalize(grid, points, p)
    return pose, found, time.thread_time() - began


def figures(results: list[tuple[Array, Relocation, float]], is_own: bool) -> dict[str, float]:
    """Verdicts, wrong poses among the unique ones, and times."""
    verdicts = Counter(found.verdict for _, found, _ in results)
    wrong = 0
    for truth, found, _ in results:
        if found.verdict is Verdict.UNIQUE and found.pose is not None:
            x, y, turn = se2.between(truth, found.pose)
            wrong += not (is_own and np.hypot(x, y) < RIGHT[0] and abs(turn) < RIGHT[1])
    seconds = np.array([t for _, _, t in results])
    return {
        **{v.value: float(verdicts[v]) for v in Verdict},
        'wrong': float(wrong),
        'median_s': float(np.median(seconds)),
        'p99_s': float(np.quantile(seconds, 0.99)),
        'worst_s': float(np.max(seconds)),
    }


def text(out: dict[str, float], rows: dict[str, dict[str, float]]) -> str:
    """The table as text."""
    head = (
        f'{out["area_m2"]:.0f} m2; pyramid {out["pyramid_s"]:.2f} s, {out["pyramid_mb"]:.0f} MB\n'
    )
    names = list(next(iter(rows.values())))
    cells = [['scans', *names]]
    for name, row in rows.items():
        cells.append(
            [name, *(f'{row[k]:.2f}' if k.endswith('_s') else f'{row[k]:.0f}' for k in names)]
        )
    return head + aligned(cells)
