# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab fleet replay``: many bags through the system, against the run before."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rlml_lab.fleet.bags import find_bags, in_words
from rlml_lab.fleet.comparison import (
    LIMITS,
    Effect,
    Verdict,
    compare,
    effect_rows,
    effects,
    limits_with,
)  # fmt: skip
from rlml_lab.fleet.fleet_options import add_options, values_of
from rlml_lab.fleet.page import fleet_page
from rlml_lab.fleet.replay_job import Job, code_digest
from rlml_lab.fleet.results import Record, Results
from rlml_lab.fleet.run import replay_all, write_tables
from rlml_lab.support.cluster import open_client
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.params import from_mapping
from rlml_slam.recordings.bag_replay import SYSTEMS

SHOWN = 20  # bags that are named on the terminal


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab fleet replay``."""
    defaults = ', '.join(f'{k} {v.step:g} or {v.share:.0%}' for k, v in LIMITS.items())
    parser = subparsers.add_parser(
        'replay',
        help='many bags through the system, against the run before',
        description='One folder per bag, as `rlml replay` writes it, and fleet.html, '
        'fleet.parquet and fleet.csv of all. What is there already is not computed again. Exit '
        'code 1 where a bag got worse than in the baseline, or without a baseline where one '
        'failed.',
    )
    add_options(parser)
    parser.add_argument('--baseline', metavar='DIR', help='results of an earlier run to compare')
    parser.add_argument(
        '--limit', metavar='NAME=STEP[,SHARE]', action='append', default=[],
        help='a figure may get worse by the step or the share of its old value, whichever is '
        f'larger; defaults: {defaults.replace("%", "%%")}',
    )  # fmt: skip
    parser.add_argument(
        '--same-bytes', action='store_true',
        help='the change is meant to change no result: another byte is worse',
    )  # fmt: skip
    parser.add_argument('--mcap', action='store_true', help='also write run.mcap of each bag')
    parser.add_argument('--no-report', action='store_true', help='no report.html of each bag')


def run(args: argparse.Namespace) -> int:
    """Replay, write, compare, print."""
    params = from_mapping(values_of(args), SYSTEMS[args.system][0])
    limits = limits_with(args.limit)
    results = Results(args.out)
    old = Results(args.baseline).read_all() if args.baseline else []
    code, out = code_digest(), results.url
    jobs = [
        Job(bag, params, out, code, args.system, not args.no_report, args.mcap)
        for bag in find_bags(args.bags)
    ]
    results.try_to_write()
    with (
        open_client(args.cluster, args.jobs) as client,
        Progress('fleet', len(jobs), args.json) as bar,
    ):
        records = replay_all(client, jobs, bar.update)
    write_tables(results, records)
    verdicts = compare(old, records, limits, args.same_bytes)
    found = effects(old, records)
    page = fleet_page(records, verdicts, found, limits)
    results.write(page.encode(), 'fleet.html')
    figures = _figures(records, old, verdicts)
    print(json.dumps(figures) if args.json else _text(figures, found, results))
    return 1 if figures['worse'] or (not args.baseline and figures['status']['failed']) else 0


def _figures(
    records: Sequence[Record], old: Sequence[Record], verdicts: Sequence[Verdict]
) -> dict[str, Any]:
    status = Counter({'ok': 0, 'partial': 0, 'failed': 0})
    status.update(r.row['status'] for r in records)
    missing = {r.name for r in old} - {r.name for r in records}
    return {
        'bags': len(records),
        'found_again': sum(bool(r.times.get('reused')) for r in records),
        'status': dict(status),
        'problems': {r.name: r.row['problem'] for r in records if r.row['problem']},
        'compared': len(verdicts),
        'same_bytes': sum(v.is_same for v in verdicts),
        'worse': {v.name: v.worse for v in verdicts if v.worse},
        'not_replayed': sorted(missing),
    }


def _text(f: dict[str, Any], found: Sequence[Effect], results: Results) -> str:
    s = f['status']
    lines = [
        f'{in_words(f["bags"])}: {s["ok"]} without a problem, {s["partial"]} in part, '
        f'{s["failed"]} failed; {f["found_again"]} found again'
    ]
    lines += [f'  {name}: {why}' for name, why in list(f['problems'].items())[:SHOWN]]
    if f['compared']:
        lines.append(
            f'{f["compared"]} compared: {f["same_bytes"]} with the same bytes, '
            f'{len(f["worse"])} got worse'
        )
        lines += [f'  {n}: {"; ".join(why)}' for n, why in list(f['worse'].items())[:SHOWN]]
        lines.append(aligned([['figure', 'bags', 'mean change', '95 %', ''], *effect_rows(found)]))
    if f['not_replayed']:
        lines.append(f'not replayed of the baseline: {in_words(len(f["not_replayed"]))}')
    return '\n'.join([*lines, f'report: {results.path("fleet.html")}'])
