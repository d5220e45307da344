# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench back-end``: the graph solver against g2o, GTSAM and Ceres, interleaved.

Every graph is solved from the start in its file and from its odometry. A solver's figure is the
CPU time of the call that optimises, structure and ordering included, median of the runs; chi2 is
computed by one evaluator. The order of the solvers is random in every run, and the heap is
sorted before each: else one of them would always find the caches and the free lists as the same
other one leaves them, which on graphs of 100 poses is half of its time.

A rival that has no stopping rule (g2o) is given the fewest iterations that bring it within 0.1 %
of the best chi2, which no user could know beforehand.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from rlml_lab.bench.generated_graphs import POOR_SIGMA, city, warehouse
from rlml_lab.bench.rivals import Run, Solver, installed, single_thread
from rlml_slam.errors import RlmlError
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.solver import warm_up
from rlml_slam.graph.g2o import read_graph
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array

SAME = 1.001  # chi2 within this factor of the best is the same optimum
LIMIT = 100  # iterations, for solvers that stop by themselves
SUFFIXES = ('.g2o', '.graph', '.g2o.gz')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench back-end``."""
    parser = subparsers.add_parser(
        'back-end',
        help='the graph solver against other libraries',
        description='Compares with whatever of g2o, GTSAM and Ceres is installed '
        "(pip install '.[bench]' 'numpy<2' in an environment of its own: g2o-python needs it).",
    )
    parser.add_argument('graphs', nargs='*', type=Path, help='g2o/TORO files or folders of them')
    parser.add_argument('--generated', action='store_true', help='also generated graphs')
    parser.add_argument('--runs', type=int, default=7, help='interleaved runs (default 7)')
    parser.add_argument('--without', action='append', default=[], help='leave out a library')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    single_thread()
    if args.runs < 1:
        raise RlmlError(f'--runs {args.runs} is not at least 1')
    libraries = {name: m for name, m in installed().items() if name not in args.without}
    if 'g2o' in libraries and int(np.__version__.partition('.')[0]) >= 2:
        raise RlmlError(
            f'g2o-python dies of NumPy {np.__version__}: take an environment with '
            "'numpy<2', or --without g2o"
        )
    warm_up()
    solvers = {name: solver for m in libraries.values() for name, solver in m.items()}
    results = []
    for name, graph in _graphs(args.graphs, args.generated):
        for start in ('file', 'odometry'):
            if start == 'odometry':
                initialize(graph, 'odometry')
            result = _compare(graph, solvers, args.runs)
            result = {'graph': name, 'start': start, **result}
            results.append(result)
            if not args.json:
                _print(result)
    if args.json:
        print(json.dumps({'results': results}))
    elif results:
        _print_summary(results)
    return 0


def read_graphs(paths: list[Path]) -> Iterator[tuple[str, Graph]]:
    """The graph files among ``paths`` and in folders among them."""
    for path in paths:
        files = sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
        for file in files:
            if not path.is_dir() or file.name.endswith(SUFFIXES):
                try:
                    yield file.name, read_graph(file).graph
                except RlmlError:
                    if not path.is_dir():
                        raise


def _graphs(paths: list[Path], generated: bool) -> Iterator[tuple[str, Graph]]:
    yield from read_graphs(paths)
    if generated:
        yield 'city 10 000', city(10_000)
        yield 'city 3500, headings off by 0.3 rad', city(3500, sigma=POOR_SIGMA)
        yield 'warehouse 1000', warehouse(1000, 150)
        yield 'warehouse 3300', warehouse(3300, 576)


def _compare(graph: Graph, solvers: dict[str, Solver], runs: int) -> dict[str, Any]:
    start = graph.poses.copy(), graph.landmarks.copy()
    chi2_start = graph.chi2()
    found = {name: _calibrate(graph, start, name, solver) for name, solver in solvers.items()}
    best = min(chi2 for chi2, _ in found.values())
    plan = {}
    for name, (chi2, iterations) in found.items():
        if name.startswith('g2o') and chi2 <= SAME * best:
            iterations = _fewest(graph, start, solvers[name], iterations, SAME * best)
        plan[name] = iterations
    times: dict[str, list[Run]] = {name: [] for name in solvers}
    final = {}
    taking_part = [n for n in solvers if n == 'rlml' or found[n][0] <= SAME * best]
    rng = np.random.default_rng(0)
    for _ in range(runs):
        for name in rng.permutation(taking_part).tolist():
            _sort_heap()
            once, final[name] = _once(graph, start, solvers[name], plan[name])
            times[name].append(once)
    rows: dict[str, dict[str, Any]] = {}
    for name in solvers:
        if times[name]:
            ms = median(r.cpu_ms for r in times[name])
            steps = times[name][0].iterations
            rows[name] = {'chi2': final[name], 'iterations': steps, 'cpu_ms': ms}
        else:
            rows[name] = {'chi2': found[name][0], 'iterations': found[name][1], 'cpu_ms': None}
    rivals = [r['cpu_ms'] for n, r in rows.items() if n != 'rlml' and r['cpu_ms'] is not None]
    ratio = rows['rlml']['cpu_ms'] / min(rivals) if rivals and 'rlml' in rows else None
    graph.poses[:], graph.landmarks[:] = start
    sizes = {'poses': len(graph.poses), 'landmarks': len(graph.landmarks),
             'factors': len(graph.edges) + len(graph.sightings)}  # fmt: skip
    return {**sizes, 'chi2_start': chi2_start, 'solvers': rows, 'ratio': ratio}


def _once(
    graph: Graph, start: tuple[Array, Array], solver: Solver, iterations: int
) -> tuple[Run, float]:
    """(run, chi2) from the start."""
    graph.poses[:], graph.landmarks[:] = start
    once = solver(graph, iterations)
    return once, graph.chi2()


def _sort_heap() -> None:
    """Ask for memory of a few sizes: the first who does sorts what all others have given back."""
    for size in (100, 1000, 5000):
        np.empty(size)


def _calibrate(
    graph: Graph, start: tuple[Array, Array], name: str, solver: Solver
) -> tuple[float, int]:
    """(chi2 reached, iterations taken) with all the iterations that a solver may want."""
    # g2o's Gauss-Newton does not stop, and 12 steps are plenty where it converges at all
    limit = 12 if name == 'g2o GN' else LIMIT
    with contextlib.suppress(RuntimeError):
        once, chi2 = _once(graph, start, solver, limit)
        return chi2 if chi2 == chi2 else float('inf'), once.iterations
    return float('inf'), 0


def _fewest(
    graph: Graph, start: tuple[Array, Array], solver: Solver, most: int, target: float
) -> int:
    """The fewest iterations that bring chi2 to the target."""
    for iterations in range(1, most):
        if _once(graph, start, solver, iterations)[1] <= target:
            return iterations
    return most


def _print(result: dict[str, Any]) -> None:
    print(
        f'{result["graph"]} from {result["start"]}: {result["poses"]} poses, '
        f'{result["landmarks"]} landmarks, {result["factors"]} factors, '
        f'chi2 {result["chi2_start"]:.6g}'
    )
    for name, row in result['solvers'].items():
        ms = '   other optimum' if row['cpu_ms'] is None else f'{row["cpu_ms"]:13.2f} ms'
        print(f'  {name:9} chi2 {row["chi2"]:12.6g} {row["iterations"]:4d} iterations {ms}')
    if result['ratio'] is not None:
        print(f'  rlml / fastest rival at the same optimum: {result["ratio"]:.2f}')


def _print_summary(results: list[dict[str, Any]]) -> None:
    print(f'\n{"graph":34} {"start":8} {"chi2":>10} {"rlml ms":>8} {"rival ms":>9} ratio')
    for result in results:
        rows = result['solvers']
        rivals = [r['cpu_ms'] for n, r in rows.items() if n != 'rlml' and r['cpu_ms'] is not None]
        print(
            f'{result["graph"]:34} {result["start"]:8} {rows["rlml"]["chi2"]:10.5g} '
            f'{rows["rlml"]["cpu_ms"]:8.2f} '
            + (f'{min(rivals):9.2f} {result["ratio"]:.2f}' if rivals else '     none at this chi2')
        )
