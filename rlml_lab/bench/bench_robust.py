# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench robust``: graphs with wrong closures, against GTSAM's GNC, Cauchy and DCS.

Every solver starts from odometry. An error is the ATE, aligned, against the optimum of the graph
without wrong closures: 0 is a solver that found exactly the right ones. Beside it stands the chi2
of the right edges at the poses found, as a multiple of their least. GTSAM's GNC is given that
odometry is right, and has its truncation at 99 %, as ours. A rival that takes longer than it may
is stopped, and listed apart from those that came to an end.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from typing import Any

from rlml_lab.bench.bench_back_end import read_graphs
from rlml_lab.bench.generated_graphs import city
from rlml_lab.bench.graduated_non_convexity import graduate
from rlml_lab.bench.rivals import single_thread, timed
from rlml_lab.bench.robust_cases import (
    EXACT,
    Cases,
    Judged,
    Method,
    Outcome,
    Wrong,
    parse_wrong,
    summary,
)
from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import RlmlError
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.graph.robust.closure_selection import select_closures

COUNTS = ('0', '10', '50', '100', '500', '1000', '20%')
KERNEL = 1.0  # sigmas, of Cauchy and DCS
SELECT = 'select'  # what this package does; the others are there to be compared with
# an error is worse if it is larger by this share and by a millimetre, which no sensor sees
SAME, NOTHING = 0.01, 1e-3


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench robust``."""
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
    parser.add_argument(
        '--rival-seeds', type=int, metavar='N',
        help='draws that all but select solve (default: all): the others are much slower',
    )  # fmt: skip
    parser.add_argument(
        '--limit', type=float, default=300.0, metavar='SECONDS',
        help='CPU time after which a solve of a rival is stopped (default %(default)g)',
    )  # fmt: skip
    parser.add_argument(
        '--keep', type=Path, metavar='DIR',
        help='write every result there at once; what is there is not measured again, unless '
        'it is of this solver and its sources have changed',
    )  # fmt: skip
    parser.add_argument('--without', action='append', default=[], help='leave out a solver')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    single_thread()
    rival_seeds = args.seeds if args.rival_seeds is None else args.rival_seeds
    for name, value in (('--seeds', args.seeds), ('--rival-seeds', rival_seeds)):
        if value < 1:
            raise RlmlError(f'{name} {value} is not at least 1')
    if not args.limit > 0.0:
        raise RlmlError(f'--limit {args.limit:g} is not more than 0')
    counts = [parse_wrong(word) for word in args.wrong]
    methods = _methods()
    own = list(methods)
    for method in methods.values():  # compiles what it needs
        method(city(60))
    rivals, close = _rivals(args.limit)
    methods = {name: m for name, m in {**methods, **rivals}.items() if name not in args.without}
    results = []
    try:
        for name, graph in read_graphs(args.graphs):
            if len(graph.landmarks) or not (graph.edges.kinds == FactorKind.CLOSURE).any():
                continue
            cases = Cases(name, graph, args.keep, own)
            results.append({'graph': name, 'poses': len(graph.poses), 'closures': cases.right})
            if not args.json:
                _print_head(results[-1])
            results[-1]['rows'] = rows = []
            for wrong in counts:
                rows += study(cases, wrong, methods, args.seeds, rival_seeds, args.json)
    finally:
        close()
    if args.json:
        print(json.dumps({'results': results}))
    return 0


def _methods() -> dict[str, Method]:
    """The solvers of this package, by name."""
    return {
        SELECT: _select, 'gnc': _gnc,
        'cauchy': lambda graph: _kernel(graph, LossKind.CAUCHY),
        'dcs': lambda graph: _kernel(graph, LossKind.DCS),
    }  # fmt: skip


def _rivals(limit: float) -> tuple[dict[str, Method], Any]:
    """(The solvers of GTSAM where it is installed, what ends their process)."""
    if not importlib.util.find_spec('gtsam'):
        return {}, lambda: None
    from rlml_lab.bench.robust_rivals import Rivals, run_gnc, run_kernel

    rivals = Rivals(limit)
    out: dict[str, Method] = {
        'gtsam gnc': lambda graph: rivals.run(run_gnc, graph),
        'gtsam cauchy': lambda graph: rivals.run(run_kernel, graph, 'Cauchy', KERNEL),
        'gtsam dcs': lambda graph: rivals.run(run_kernel, graph, 'DCS', KERNEL),
    }
    return out, rivals.close


def _select(graph: Graph) -> Outcome:
    ms, chosen = timed(lambda: select_closures(graph, EXACT))
    return Outcome(ms, chosen.accepted)


def _gnc(graph: Graph) -> Outcome:
    ms, graduated = timed(lambda: graduate(graph, EXACT))
    return Outcome(ms, graduated.weights >= 0.5)


def _kernel(graph: Graph, kind: LossKind) -> Outcome:
    graph.losses = Losses(closure=Loss(kind, KERNEL))
    return Outcome(timed(lambda: optimize(graph, EXACT))[0])


def study(
    cases: Cases, wrong: Wrong, methods: dict[str, Method], seeds: int, rival_seeds: int,
    quiet: bool,
) -> list[dict[str, Any]]:  # fmt: skip
    """One row per solver over the draws, printed when they are done.

    ``worse_than`` has, per rival, in how many of the draws that both solved to the end the error
    of select is larger than the rival's.
    """
    draws: list[dict[str, Judged]] = []
    num = seeds if wrong.number or wrong.share else 1
    with Progress(f'{wrong} wrong closures', float(num), quiet) as progress:
        for seed in range(num):
            own = {name: m for name, m in methods.items() if name == SELECT or seed < rival_seeds}
            draws.append(cases.solve(wrong, seed, own))
            progress.update(float(seed + 1))
    rows: list[dict[str, Any]] = []
    for name in methods:
        each = [one[name] for one in draws if name in one]
        rows.append({'wrong': str(wrong), 'method': name, **summary(each)})
        if name == SELECT:
            rows[-1]['worse_than'] = {m: _worse(draws, m) for m in methods if m != SELECT}
        if not quiet:
            _print_row(rows[-1])
    return rows


def _worse(draws: list[dict[str, Judged]], rival: str) -> int:
    """In how many draws the error of select is larger than that of a rival."""
    both = [one for one in draws if rival in one and 'stopped' not in one[rival]]
    return sum(one[SELECT]['ate_m'] > (1.0 + SAME) * one[rival]['ate_m'] + NOTHING for one in both)


def _print_head(result: dict[str, Any]) -> None:
    print(f'{result["graph"]}: {result["poses"]} poses, {result["closures"]} right closures')
    columns = (
        'wrong method       runs  ATE median m       max m   chi2 max  missed  wrong in    CPU ms'
    )
    print(f'  {columns}  worse than')


def _print_row(row: dict[str, Any]) -> None:
    error = ' ' * 36
    if 'ate_median_m' in row:
        error = (
            f'{row["ate_median_m"]:13.4f} {row["ate_max_m"]:11.4f} {row["chi2_ratio_max"]:10.4g}'
        )
    selected = ' ' * 17
    if 'missed' in row:
        selected = f'{row["missed"]:7.1f} {row["accepted_wrong"]:9.1f}'
    worse = [f'{rival} in {k}' for rival, k in row.get('worse_than', {}).items() if k]
    stopped = [f'{row["stopped"].count(why)} {why}' for why in dict.fromkeys(row['stopped'])]
    notes = ', '.join([*worse, *(f'stopped: {one}' for one in stopped)])
    line = (
        f'  {row["wrong"]:>5} {row["method"]:13} {row["runs"]:3d} {error} {selected} '
        f'{row["cpu_ms"]:9.0f}  {notes}'
    )
    print(line.rstrip(), flush=True)
