# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study deformable``: the 8-row table over many seeds, or the note's own two runs."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table

from rlml_lab.deformable.experiment import CONTROLS, ROWS, Row
from rlml_lab.deformable.monte_carlo import RowResult, concatenate, run_row, summarize
from rlml_lab.deformable.replay_note import replay
from rlml_lab.deformable.study_deformable_tables import tables
from rlml_lab.support.parallel_jobs import Workers, add_workers, each, workers_of
from rlml_slam.errors import ParameterError, RlmlError

CHUNK = 50  # seeds per task: small enough for a moving bar, large enough to be worth sending


def add_parser(subparsers: Any) -> None:
    """Declare the command below ``study``."""
    parser = subparsers.add_parser(
        'deformable',
        help='deformable-feature SLAM: EKF against NLS over many seeds',
        description='EKF, NLS, RTS smoother and dead reckoning on the same runs of 8 experiments.',
    )
    parser.add_argument('--seeds', type=int, default=2000, help='runs per row (default 2000)')
    parser.add_argument('--control', choices=('both', *CONTROLS), default='both')
    parser.add_argument('--out', type=Path, help='folder for report.html, figures, results.json')
    parser.add_argument('--figure-seed', type=int, default=0, help='the run that is drawn')
    add_workers(parser, 0)
    parser.add_argument('--json', action='store_true', help='print the results as JSON alone')
    parser.add_argument(
        '--replay-note', type=Path, metavar='DIR', help="replay the note's stored noise instead"
    )
    parser.add_argument(
        '--window', action='store_true', help="long drives of the node's sliding window instead"
    )
    parser.add_argument(
        '--node', action='store_true', help='drives of deformable_slam itself over DDS instead'
    )
    drives = parser.add_argument_group('with --window and --node')
    drives.add_argument('--minutes', type=float, default=10.0, help='of each drive (default 10)')
    drives.add_argument('--runs', type=int, help='per carrier (default 8; of the node 1)')
    drives.add_argument('--anonymous', action='store_true', help='no ids, and ghosts')
    drives.add_argument(
        '--rate', type=float, default=4.0, help='of the node: x real time (default 4)'
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the study or the replay; 0, or RlmlError."""
    if args.replay_note is not None:
        replayed = replay(args.replay_note)
        print(json.dumps(replayed)) if args.json else _show_replay(_console(), replayed)
        return 0
    if args.window or args.node:
        return _run_drives(args)
    if args.seeds < 2 or args.jobs < 0 or args.figure_seed < 0:
        raise ParameterError(
            'study deformable: --seeds must be >= 2, --jobs and --figure-seed >= 0'
        )
    rows = tuple(r for r in ROWS if args.control in ('both', r.control))
    started = time.perf_counter()
    results = run_study(rows, args.seeds, workers_of(args))
    summary = summarize(results)
    summary['wall_s'] = round(time.perf_counter() - started, 2)
    if args.out is not None:
        from rlml_lab.deformable.study_deformable_report import write_report

        write_report(args.out, summary, results, args.figure_seed)
    if args.json:
        print(json.dumps(summary))
    else:
        show(_console(), summary)
        if args.out is not None:
            print(f'report: {args.out / "report.html"}')
    return 0


def _run_drives(args: argparse.Namespace) -> int:
    """Long drives beside simulated carriers, of the window in this process or of the node."""
    from rlml_lab.deformable import study_deformable_window as window

    runs = args.runs if args.runs is not None else 1 if args.node else 8
    if not 0.5 <= args.minutes <= 1e4 or runs < 1 or args.jobs < 0 or not 0.01 <= args.rate <= 1e3:
        raise ParameterError(
            'study deformable: --minutes must be 0.5 or more, --runs 1 or more, --rate above 0'
        )
    if args.node:
        from rlml_lab.deformable import study_deformable_node as node

        drives = node.run_all(args.minutes, runs, not args.anonymous, args.rate, args.json)
        summary = node.summarize(drives)
        claims, lines = node.claims(summary), node.lines
    else:
        summary = window.summarize(
            window.run_all(args.minutes, runs, not args.anonymous, workers_of(args))
        )
        claims, lines = window.claims(summary), window.lines
    if args.json:
        print(json.dumps(summary))
        return 0
    title = 'deformable_slam over DDS' if args.node else 'The sliding window in this process'
    table = Table(title=f'{title}, beside a carrier', title_justify='left')
    table.add_column(f'{args.minutes:g} min at 10 Hz')
    columns = {f'{kind}, {f["runs"]} drives': lines(f) for kind, f in summary.items()}
    for name in columns:
        table.add_column(name, justify='right')
    for name in next(iter(columns.values())):
        table.add_row(name, *(column[name] for column in columns.values()))
    _console().print(table)
    _show_claims(_console(), [(claim, '', holds) for claim, holds in claims])
    return 0


def _show_claims(console: Console, claims: Sequence[tuple[str, str, bool]]) -> None:
    """How many (claim, figures, whether it holds) hold, and which do not."""
    failed = [(claim, found) for claim, found, holds in claims if not holds]
    console.print(f'{len(claims) - len(failed)} of {len(claims)} claims hold')
    for claim, found in failed:
        console.print(f'  not shown: {claim}{found and ": "}{found}', markup=False)


def run_study(rows: tuple[Row, ...], seeds: int, workers: Workers) -> dict[Row, RowResult]:
    """Results of ``rows`` over seeds 0 .. seeds-1, whatever the number of processes.

    A bar on stderr shows the progress.
    """
    tasks = [
        (row, range(k, min(k + CHUNK, seeds)))
        for row in sorted(rows, key=lambda r: r.control != 'active')  # the long ones first
        for k in range(0, seeds, CHUNK)
    ]
    parts: dict[Row, dict[int, RowResult]] = {row: {} for row in rows}
    with Progress(
        '{task.description}', BarColumn(), MofNCompleteColumn(), 'runs', TimeElapsedColumn(),
        console=Console(stderr=True),
    ) as progress:  # fmt: skip
        bar = progress.add_task('compiling', total=len(rows) * seeds)
        run_row(Row('straight', 'fixed', 'active'), range(1))  # fills the cache for all processes
        progress.update(bar, description='simulating')
        for (row, part), result in each(run_row, tasks, workers):
            parts[row][part.start] = result
            progress.advance(bar, len(part))
    return {row: concatenate(p for _, p in sorted(parts[row].items())) for row in rows}


def _console() -> Console:
    """The terminal; a pipe gets lines wide enough for the tables."""
    console = Console()
    return console if console.is_terminal else Console(width=170)


def show(console: Console, summary: dict[str, Any]) -> None:
    """The tables of the study."""
    for title, header, lines in tables(summary):
        table = Table(title=escape(title), title_justify='left')
        for k, name in enumerate(header):
            table.add_column(escape(name), justify='left' if k == 0 else 'right', no_wrap=k == 0)
        for line in lines:
            table.add_row(*line)
        console.print(table)
    _show_claims(console, [(f'{c["claim"]}, {c["where"]}', c['found'], c['holds'])
                           for c in summary['claims']])  # fmt: skip
    console.print(f'{summary["seeds"]} seeds, {summary["wall_s"]} s')


def _show_replay(console: Console, replayed: dict[str, Any]) -> None:
    """Our figures beside the note's Table 1."""
    table = Table(title="The note's two runs, from its stored noise", title_justify='left')
    for name in ('path', 'NLS is given', 'EKF', 'NLS', 'EKF, note', 'NLS, note'):
        table.add_column(name, justify='left' if name in ('path', 'NLS is given') else 'right')
    for path, r in replayed.items():
        for key, given in (('leak_on', 'realised motion'), ('leak_off', 'nominal motion')):
            note = r['note'] if key == 'leak_on' else {'ekf': None, 'nls': None}
            table.add_row(
                path, given, f'{r[key]["ekf"]:.4f}', f'{r[key]["nls"]:.4f}',
                *('' if note[e] is None else f'{note[e]:.4f}' for e in ('ekf', 'nls')),
            )  # fmt: skip
    console.print(table)
    for path, r in replayed.items():
        console.print(
            f'{path}: EKF given the realised motion too {r["ekf_leaked"]:.4f}; on the nominal '
            f'motion RTS smoother {r["rts"]:.4f}, dead reckoning {r["dead_reckoning"]:.4f}'
        )


def main() -> int:
    """``python -m rlml_lab.deformable.study_deformable``, the study on its own."""
    parser = argparse.ArgumentParser(prog='study')
    add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(['deformable', *sys.argv[1:]])
    try:
        return run(args)
    except RlmlError as e:
        print(f'error: {e}', file=sys.stderr)
        return 1


if __name__ == '__main__':
    sys.exit(main())
