# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study sweep``: what a parameter changes, over many bags."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from rlml_lab.fleet.bags import find_bags, in_words
from rlml_lab.fleet.comparison import effect_rows, effects
from rlml_lab.fleet.fleet_options import add_options, values_of
from rlml_lab.fleet.replay_job import Job, code_digest
from rlml_lab.fleet.results import Results
from rlml_lab.fleet.run import columns_of, csv_of, replay_all, write_tables
from rlml_lab.support.cluster import open_client
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.errors import ParameterError
from rlml_slam.params import from_mapping
from rlml_slam.plain_yaml import parse_yaml
from rlml_slam.recordings.bag_replay import SYSTEMS

REFERENCE = 'reference'


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study sweep``."""
    parser = subparsers.add_parser(
        'sweep',
        help='what values of parameters change, over many bags',
        description='Replays all bags with the parameters as they are, and with each value of '
        'each --set alone. Prints the mean of the paired differences with a 95 % interval '
        '(bootstrap over the bags).'.replace('%', '%%'),
    )
    add_options(parser)
    parser.add_argument(
        '--set', metavar='NAME=VALUE,VALUE…', action='append', required=True, dest='sets',
        help='a parameter and its values; may be repeated',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Replay all, compare each value with the reference, print and write effects.csv."""
    kind = SYSTEMS[args.system][0]
    base = values_of(args)
    variants = {REFERENCE: base} | {k: base | v for k, v in variants_of(args.sets).items()}
    params = {name: from_mapping(values, kind) for name, values in variants.items()}
    results = Results(args.out)
    bags, code = find_bags(args.bags), code_digest()
    jobs = [
        Job(bag, p, f'{results.url}/{name}', code, args.system, report=False)
        for name, p in params.items()
        for bag in bags
    ]
    results.try_to_write()
    with (
        open_client(args.cluster, args.jobs) as client,
        Progress('sweep', len(jobs), args.json) as bar,
    ):
        records = replay_all(client, jobs, bar.update)
    n = len(bags)
    runs = {name: records[k * n : (k + 1) * n] for k, name in enumerate(params)}
    for name, found in runs.items():
        write_tables(Results(f'{results.url}/{name}'), found)
    table = {name: effects(runs[REFERENCE], found) for name, found in runs.items()}
    del table[REFERENCE]
    rows = [{'variant': v, **asdict(e)} for v, found in table.items() for e in found]
    results.write(csv_of(columns_of(rows), rows), 'effects.csv')
    failed = sum(r.row['status'] == 'failed' for r in records)
    if args.json:
        print(json.dumps({'bags': n, 'failed': failed, 'effects': rows}))
    else:
        print(f'{in_words(n)}, {len(runs)} variants; {failed} of {len(jobs)} runs failed')
        head = ['value', 'figure', 'bags', 'mean change', '95 %', '']
        print(aligned([head, *([v, *r] for v, f in table.items() for r in effect_rows(f))]))
    return 1 if failed == len(jobs) else 0


def variants_of(sets: list[str]) -> dict[str, dict[str, Any]]:
    """NAME=VALUE -> the one value that differs. ParameterError where a text is not like that."""
    variants: dict[str, dict[str, Any]] = {}
    for text in sets:
        name, equals, values = text.partition('=')
        if not equals or not name.strip() or not values.strip():
            raise ParameterError(f'--set {text}: is not NAME=VALUE,VALUE…')
        for value in parse_yaml(f'[{values}]', f'--set {text}'):
            variants[f'{name.strip()}={value}'] = {name.strip(): value}
    return variants
