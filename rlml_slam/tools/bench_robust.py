# SPDX-License-Identifier: Apache-2.0
"""``rlml bench robust``: graphs with wrong closures, against GTSAM's GNC, Cauchy and DCS.

Every solver starts from odometry. An error is the ATE, aligned, against the optimum of the graph
without wrong closures: 0 is a solver that found exactly the right ones. GTSAM's GNC is told that
odometry is right, and has its truncation at 99 %, as ours.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rlml_slam import params, se2
from rlml_slam.errors import RlmlError
from rlml_slam.graph.gnc import graduate
from rlml_slam.graph.graph import Graph
from rlml_slam.graph.initialize import initialize
from rlml_slam.graph.robust import Loss, Losses, LossKind
from rlml_slam.graph.selection import select_closures
from rlml_slam.graph.solver import optimize, warm_up
from rlml_slam.graph.table import FactorKind
from rlml_slam.se2 import Array
from rlml_slam.tools.bench_back_end import read_graphs
from rlml_slam.tools.bench_rivals import single_thread, timed
from rlml_slam.tools.progress import Progress
from rlml_slam.tools.wrong_closures import add_clustered, add_random, copied

COUNTS = ('0', '10', '50', '100', '500', '1000', '20%')
EXACT = params.Solver(max_iterations=200, relative_tolerance=1e-10)
KERNEL = 1.0  # sigmas, of Cauchy and DCS


class Outcome(NamedTuple):
    """CPU time [ms], and which closures are in the graph afterwards (k,), None of a kernel."""

    cpu_ms: float
    accepted: Any


Method = Callable[[Graph], Outcome]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml bench robust``."""
    parser = subparsers.add_parser(
        'robust',
        help='wrong closures in graphs, against GTSAM',
        description='Adds wrong closures: random ones by number, or a share of the closures in '
        'groups that agree. Compares with GTSAM where it is installed.',
    )
    parser.add_argument('graphs', nargs='+', type=Path, help='g2o/TORO files or folders of them')
    parser.add_argument(
        '--wrong', nargs='+', default=list(COUNTS), metavar='N',
        help='numbers of random ones, or like 20%% of clustered ones (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--seeds', type=int, default=10, help='draws of each (default 10)')
    parser.add_argument('--without', action='append', default=[], help='leave out a solver')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    single_thread()
    if args.seeds < 1:
        raise RlmlError(f'--seeds {args.seeds} is not at least 1')
    counts = [_count(word) for word in args.wrong]
    warm_up()
    chosen = {name: m for name, m in methods().items() if name not in args.without}
    results = []
    for name, graph in read_graphs(args.graphs):
        if len(graph.landmarks) or not (graph.edges.kinds == FactorKind.CLOSURE).any():
            continue
        result = {'graph': name, **study(graph, chosen, counts, args.seeds, args.json)}
        results.append(result)
        if not args.json:
            _print(result)
    if args.json:
        print(json.dumps({'results': results}))
    return 0


def _count(word: str) -> float:
    """A number of random closures, or minus the share of clustered ones."""
    number = word.removesuffix('%')
    if not number.isdecimal():
        raise RlmlError(f'--wrong {word}: neither a number nor a percentage')
    return -float(number) / 100.0 if word.endswith('%') else float(number)


def methods() -> dict[str, Method]:
    """The solvers that are there, by name."""
    out: dict[str, Method] = {
        'select': _select, 'gnc': _gnc,
        'cauchy': lambda graph: _kernel(graph, LossKind.CAUCHY),
        'dcs': lambda graph: _kernel(graph, LossKind.DCS),
    }  # fmt: skip
    if importlib.util.find_spec('gtsam'):
        from rlml_slam.tools import robust_rivals as rivals

        out['gtsam gnc'] = lambda graph: Outcome(*rivals.run_gnc(graph))
        out['gtsam cauchy'] = lambda graph: Outcome(
            rivals.run_kernel(graph, 'Cauchy', KERNEL), None
        )
        out['gtsam dcs'] = lambda graph: Outcome(rivals.run_kernel(graph, 'DCS', KERNEL), None)
    return out


def _select(graph: Graph) -> Outcome:
    ms, chosen = timed(lambda: select_closures(graph, EXACT))
    return Outcome(ms, chosen.accepted)


def _gnc(graph: Graph) -> Outcome:
    ms, graduated = timed(lambda: graduate(graph, EXACT))
    return Outcome(ms, graduated.weights >= 0.5)


def _kernel(graph: Graph, kind: LossKind) -> Outcome:
    graph.losses = Losses(closure=Loss(kind, KERNEL))
    return Outcome(timed(lambda: optimize(graph, EXACT))[0], None)


def study(
    graph: Graph, methods: dict[str, Method], counts: list[float], seeds: int, quiet: bool
) -> dict[str, Any]:
    """Errors of all methods over counts and seeds."""
    right = int(np.sum(graph.edges.kinds == FactorKind.CLOSURE))
    best = copied(graph)
    initialize(best, 'chordal')
    optimize(best, EXACT)
    rows = []
    with Progress('wrong closures', float(len(counts) * seeds), quiet) as progress:
        for c, count in enumerate(counts):
            outcomes: dict[str, list[dict[str, float]]] = {name: [] for name in methods}
            for seed in range(seeds if count else 1):
                rng = np.random.default_rng(seed)
                spoilt = copied(graph)
                if count < 0.0:
                    add_clustered(spoilt, best.poses, round(-count * right), rng)
                elif count > 0.0:
                    add_random(spoilt, int(count), rng)
                initialize(spoilt, 'odometry')
                for name, method in methods.items():
                    outcomes[name].append(_judge(spoilt, method, best.poses, right))
                progress.update(float(c * seeds + seed + 1), '')
            for name, each in outcomes.items():
                rows.append({'wrong': _named(count), 'method': name, **_summary(each)})
    return {'poses': len(graph.poses), 'closures': right, 'rows': rows}


def _named(count: float) -> str:
    return f'{-100.0 * count:.0f}%' if count < 0.0 else f'{count:.0f}'


def _judge(graph: Graph, method: Method, best: Array, right: int) -> dict[str, float]:
    """One solver on a copy of a graph."""
    own = copied(graph)
    cpu_ms, accepted = method(own)
    T = se2.align(own.poses[:, :2], best[:, :2])
    error = np.hypot(*(se2.transform(T, own.poses[:, :2]) - best[:, :2]).T)
    out = {'ate_m': float(np.sqrt(np.mean(error**2))), 'cpu_ms': cpu_ms}
    if accepted is not None:
        out['missed'] = float(np.sum(~accepted[:right]))
        out['accepted_wrong'] = float(np.sum(accepted[right:]))
    return out


def _summary(each: list[dict[str, float]]) -> dict[str, float]:
    ate = [one['ate_m'] for one in each]
    out = {'runs': len(each), 'ate_median_m': float(np.median(ate)), 'ate_max_m': max(ate)}
    for name in each[0].keys() - {'ate_m'}:
        out[name] = float(np.mean([one[name] for one in each]))
    return out


def _print(result: dict[str, Any]) -> None:
    print(f'{result["graph"]}: {result["poses"]} poses, {result["closures"]} right closures')
    print('  wrong method          ATE median m       max m  missed  wrong in    CPU ms')
    for row in result['rows']:
        selected = (
            f'{row["missed"]:7.1f} {row["accepted_wrong"]:9.1f}' if 'missed' in row else ' ' * 17
        )
        print(
            f'  {row["wrong"]:>5} {row["method"]:14} {row["ate_median_m"]:13.4f} '
            f'{row["ate_max_m"]:11.4f} {selected} {row["cpu_ms"]:9.0f}'
        )
