# SPDX-License-Identifier: Apache-2.0
"""``study contact``: messages that nobody should send, in process and over DDS.

Every field of every input is changed (lengths, numbers, stamps, frames), and random bytes are
sent. No exception may escape, no message may hang a node, and the poses of a good stream beside
them have to go on.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

from rlml_lab.contact import in_process, over_dds
from rlml_slam.errors import RlmlError
from rlml_slam.params.simulator import Laser

SHARE, WORSE = 0.95, 2.0  # of the clean poses, and of their error
GROWTH = 20.0  # [MB]
RATIO = 0.5  # mutated messages for each good one of the sensors
SCANS = Laser().rate  # [Hz] of the simulator
FLOOR = 0.02  # [m] of error that is no change


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study contact``."""
    parser = subparsers.add_parser(
        'contact', help='messages that nobody should send: nodes go on, poses too'
    )
    parser.add_argument('--messages', type=int, default=1_000_000, help='in process')
    parser.add_argument('--dds', type=int, default=100_000, help='over DDS')
    parser.add_argument('--rate', type=float, default=100.0, help='of these [Hz]')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--log', type=Path, default=Path('contact_log'), help='folder of logs')


def run(args: argparse.Namespace) -> int:
    """Figures of each part; 1 where a bound is not kept."""
    if args.rate <= 0.0:
        raise RlmlError(f'--rate is {args.rate:g} Hz; it must be above 0')
    bad: list[str] = []
    if args.messages:
        before = Path.cwd()
        with tempfile.TemporaryDirectory(prefix='rlml_contact_') as folder:
            os.chdir(folder)  # maps are saved there
            try:
                bad += _in_process(args.messages, args.seed)
            finally:
                os.chdir(before)
    if args.dds:
        bad += _over_dds(args)
    for text in bad:
        print(f'NOT KEPT: {text}')
    return int(bool(bad))


def _in_process(messages: int, seed: int) -> list[str]:
    bad: list[str] = []
    clean = in_process.sensors(0.0, seed)
    truth = in_process.truth_of_room()
    for k in range(2):  # the second one shows whether memory grows
        dirty = in_process.sensors(RATIO, seed + 1 + k)
        share, before, after = in_process.compared(clean, dirty, truth)
        print(*dirty.lines('beside a good stream'), sep='\n')
        text = f'poses {100 * share:.1f} % of clean, error {before:.4f} -> {after:.4f} m'
        print(f'  {text}')
        bad += dirty.problems()
        if share < SHARE or after > max(WORSE * before, FLOOR):
            bad.append(text)
    contact = in_process.topics(messages // 5, seed)
    first = in_process.memory()
    contact = in_process.topics(messages - messages // 5, seed + 1)
    growth = in_process.memory() - first
    print(*contact.lines('all topics'), sep='\n')
    print(f'  largest memory grew by {growth:.1f} MB in the last four fifths')
    bad += contact.problems()
    if growth > GROWTH:
        bad.append(f'memory grew by {growth:.1f} MB')
    return bad


def _over_dds(args: argparse.Namespace) -> list[str]:
    seconds = max(60.0, args.dds / args.rate)
    clean = over_dds.drive(0, args.rate, args.seed, args.log / 'clean', seconds)
    dirty = over_dds.drive(args.dds, args.rate, args.seed, args.log / 'mutated', seconds)
    (r0, e0), (r1, e1) = over_dds.figures(clean), over_dds.figures(dirty)
    text = f'poses {r0:.2f} -> {r1:.2f} Hz, error {e0:.4f} -> {e1:.4f} m'
    print(f'over DDS: {dirty.sent} messages at {dirty.rate:.3g} of {args.rate:g} Hz, {text}')
    for name, value in sorted(dirty.refused.items()):
        if 'refused' in name or 'invalid' in name or 'future' in name:
            print(f'  {name}: {value}')
    grown = f'memory grew by {dirty.growth:.1f} MB in the second half, clean {clean.growth:.1f} MB'
    print(f'  {grown}')
    kept = r1 >= SHARE * r0 and e1 <= max(WORSE * e0, FLOOR)
    bad = [] if kept else [f'over DDS: {text}']
    if r0 < SHARE * SCANS or dirty.rate < SHARE * args.rate:
        bad.append('over DDS: the machine is too slow for the rate, so the figures say little')
    # the map grows in both
    return bad if dirty.growth - clean.growth <= GROWTH else [*bad, f'over DDS: {grown}']
