# SPDX-License-Identifier: Apache-2.0
"""``rlml optimize``: optimise a pose graph file."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from rlml_slam import params
from rlml_slam.errors import FileFormatError
from rlml_slam.graph import (
    Graph,
    Loss,
    Losses,
    LossKind,
    Solution,
    optimize,
    read_graph,
    select_closures,
    write_graph,
)

INIT = ('auto', 'none', 'chordal')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml optimize``."""
    parser = subparsers.add_parser(
        'optimize',
        help='optimise a pose graph file (g2o, TORO)',
        description='Reads g2o or TORO (also .gz), poses and landmarks, and minimises chi2.',
    )
    parser.add_argument('graph', type=Path, metavar='GRAPH.g2o', help='the graph to optimise')
    parser.add_argument('--out', type=Path, metavar='OUT.g2o', help='where the result goes')
    parser.add_argument('--init', choices=INIT, default='auto', help='where the solve starts')
    parser.add_argument(
        '--robust',
        choices=[*(kind.name.lower() for kind in LossKind), 'select'],
        default='none',
        help='loss of closures and sightings; '
        'select: closures that agree with odometry and each other, the surest first',
    )
    parser.add_argument('--scale', type=float, default=2.0, help='scale of the loss, in sigmas')
    parser.add_argument('--max-iterations', type=int, default=100, help='steps at most')
    parser.add_argument('--tolerance', type=float, default=1e-6, help='relative, of the cost')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Read, optimise, write, print; exit code 0 also where the solver did not converge."""
    is_loss = args.robust.upper() in LossKind.__members__
    loss = Loss(LossKind[args.robust.upper()], args.scale) if is_loss else Loss()
    file = read_graph(args.graph, Losses(closure=loss, reflector=loss))
    parameters = params.Solver(
        max_iterations=args.max_iterations,
        relative_tolerance=args.tolerance,
        initialization=args.init,
    )
    solution, refused = _solve(file.graph, args.robust, parameters)
    if args.out is not None:
        try:
            write_graph(args.out, file.graph, file.pose_ids, file.landmark_ids)
        except OSError as error:
            raise FileFormatError(f'{args.out}: cannot be written: {error.strerror}') from None
    if args.json:
        print(json.dumps(solution._asdict() | {'refused': refused}))
        return 0
    graph = file.graph
    print(
        f'{len(graph.poses)} poses, {len(graph.landmarks)} landmarks, {len(graph.edges)} edges, '
        f'{len(graph.sightings)} sightings'
    )
    for tag, num in file.skipped.items():
        print(f'skipped {num} lines of {tag}')
    if refused:
        print(f'{len(refused)} closures disabled: they contradict the others or odometry')
    state = 'converged' if solution.converged else 'not converged'
    print(
        f'chi2 {solution.chi2_initial:.6g} -> {solution.chi2_final:.6g} in '
        f'{solution.iterations} iterations, {solution.wall_ms:.1f} ms, {state}'
    )
    return 0


def _solve(graph: Graph, robust: str, parameters: params.Solver) -> tuple[Solution, list[int]]:
    """The solution, and the edges that were disabled on the way (indices in the file)."""
    if robust != 'select':
        return optimize(graph, parameters), []
    before, began = graph.chi2(), time.perf_counter()
    chosen = select_closures(graph, parameters)
    refused = chosen.edges[~chosen.accepted].tolist()
    solution = optimize(graph, parameters)
    wall_ms = (time.perf_counter() - began) * 1e3
    # without losses the cost is chi2
    whole = solution._replace(chi2_initial=before, cost_initial=before, wall_ms=wall_ms)
    return whole, refused
