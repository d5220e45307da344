# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study faults``: what faults in a recording cost, and whether the system says so."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rlml_lab.faults import recording
from rlml_lab.faults.fault_catalog import FAULTS, chosen
from rlml_lab.faults.fault_run import FaultFigures
from rlml_lab.faults.fault_run import run as run_fault
from rlml_lab.faults.other_drives import DRIVES
from rlml_slam.cli.support.progress import Progress
from rlml_slam.params import Parameters, from_mapping, read_yaml

HEADINGS = (
    'fault', 'seed', 'error [m]', '× clean', 'heading [°]', 'LOST', 'DEGRADED', 'OK and wrong',
    'longest [s]', 'CPU [ms/scan]', '× real time',
)  # fmt: skip
WIDTHS = (max(map(len, FAULTS)), 4, 17, *map(len, HEADINGS[3:]))


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study faults``."""
    parser = subparsers.add_parser(
        'faults',
        help='faults put into a recording: error, health and cost of each',
        description='Puts faults of odometry, laser and reflector detector into a recording and '
        'replays it. OK and wrong: the pose is off by more than 0.5 m or 10° beyond 3 sigma and '
        'its health is OK. Without truth, published poses are compared with the replay without '
        'a fault.',
    )
    parser.add_argument('recording', metavar='BAG', help='a bag, or the name of a world')
    parser.add_argument(
        'reference', nargs='?', type=Path, metavar='REFERENCE',
        help='relations (*.relations), or the truth as a TUM file in the map frame',
    )  # fmt: skip
    parser.add_argument(
        '--fault', nargs='+', metavar='WORD',
        help=f'only those whose name has one of these words, of: {", ".join(FAULTS)}'
        .replace('%', '%%'),
    )  # fmt: skip
    parser.add_argument(
        '--drive', choices=DRIVES, default='recorded',
        help='the same drive as another one; default: %(default)s',
    )  # fmt: skip
    parser.add_argument('--seeds', type=int, default=1, metavar='N', help='default: %(default)s')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the system's parameters")
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Replay with each fault and each seed, and print a row for each."""
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    given = DRIVES[args.drive](recording.load(args.recording, args.reference, params))
    faults = list(chosen(args.fault))
    rows: list[tuple[str, int, FaultFigures]] = []
    reference = None
    if not args.json:
        print(line(HEADINGS), flush=True)
    with Progress('study', 1 + (len(faults) - 1) * args.seeds, args.json) as progress:
        for name, fault in faults:
            for seed in range(1 if name == 'none' else args.seeds):
                figures, path, _ = run_fault(given, fault, seed, params, reference)
                reference = reference or path
                rows.append((name, seed, figures))
                if not args.json:
                    print(line(cells(name, seed, figures, rows[0][2].mean_m)), flush=True)
                progress.update(len(rows), f'{name}: {figures.mean_m:.3f} m')
    if args.json:
        listed = [{'fault': name, 'seed': seed, **asdict(f)} for name, seed, f in rows]
        print(json.dumps({'recording': given.name, 'runs': listed}))
    return 0


def line(row: Sequence[str]) -> str:
    """One line of the table: a study may be stopped, so each is printed when its run ends."""
    return '  '.join(c.ljust(w) for c, w in zip(row, WIDTHS, strict=True)).rstrip()


def cells(name: str, seed: int, f: FaultFigures, clean: float) -> list[str]:
    """Of one run; ``clean`` is the error [m] without a fault."""
    return [
        name, str(seed), f'{f.mean_m:.4f} ± {f.std_m:.4f}',
        f'{f.mean_m / clean:.2f}' if clean > 0.0 else '', f'{f.rot_deg:.2f}',
        f'{f.lost:.2%}', f'{f.degraded:.2%}', f'{f.ok_and_wrong:.2%}', f'{f.longest_s:.1f}',
        f'{f.cpu_ms:.2f}', f'{f.real_time_factor:.0f}',
    ]  # fmt: skip
