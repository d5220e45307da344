# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study stalls``: odometry that stands still while the robot drives, then catches up.

Each seed has a speed, a turn rate, a length of the stalls and whether all of the motion comes in
one step afterwards. The laser is slow and sees half of the surroundings, as many do: 5 Hz, 180°.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.faults import fault_run
from rlml_lab.faults.fault_catalog import SECOND, Windows, none, stall
from rlml_lab.faults.recording import Recording, simulated
from rlml_lab.support.parallel_jobs import each
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import Laser, Parameters, Simulator, SimulatorParameters, Wheels
from rlml_slam.types import Imu

WORLDS = ('room', 'hall', str(Path(__file__).with_name('cluttered.yaml')))
PERIOD = 9.0  # [s] between two stalls
SETTLED = 0.4  # [s] after the end of a stall the heading is looked at
LASER = Laser(
    rate=5.0, beams=361, field_of_view=np.pi, ray_times=False, range_sigma=0.03,
    dropout_share=0.05, divergence=0.0,
)  # fmt: skip


@dataclass(frozen=True)
class Drive:
    """How a seed drives, and its stalls."""

    speed: float
    turn_rate: float
    length: float
    catches_up: bool


def drive_of(seed: int) -> Drive:
    """.2 to 1.2 m/s, up to 1.5 rad/s, stalls of .3 to 2 s; one in four does not catch up."""
    rng = np.random.default_rng(seed)
    speed, turn, length = rng.uniform((0.2, 0.4, 0.3), (1.2, 1.5, 2.0))
    return Drive(float(speed), float(turn), float(length), bool(rng.random() < 0.75))


def recorded(world: str, seed: int, drive: Drive) -> Recording:
    """The drive, without IMU and reflectors."""
    p = SimulatorParameters(
        node=Simulator(speed=drive.speed, turn_rate=drive.turn_rate, duration=60.0),
        wheels=Wheels(rate=5.0), laser=LASER,
    )  # fmt: skip
    p = replace(p, markers=replace(p.markers, enabled=False))
    whole = simulated(world, seed, p)
    return whole.having([m for m in whole.messages if not isinstance(m, Imu)])


def evaluate(
    world: str, seed: int, params: Parameters, drive: Drive | None = None
) -> dict[str, Any]:
    """Figures of one drive, that of the seed by default, with and without stalls."""
    drive = drive_of(seed) if drive is None else drive
    given = recorded(world, seed, drive)
    clean, _, before = fault_run.run(given, none, seed, params)
    fault = stall(drive.length, drive.catches_up, PERIOD)
    figures, _, log = fault_run.run(given, fault, seed, params)
    windows = Windows(given.messages, np.random.default_rng(seed), drive.length, PERIOD)
    return {
        'clean_m': clean.mean_m, 'mean_m': figures.mean_m,
        'headings': _headings(given, log, windows, drive.length),
        'clean_headings': _headings(given, before, windows, drive.length),
        'ok_and_wrong': figures.ok_and_wrong, 'longest_s': figures.longest_s,
        'lost': figures.lost, 'degraded': figures.degraded, 'cpu_ms': figures.cpu_ms,
        'clean_cpu_ms': clean.cpu_ms,
    }  # fmt: skip


def _headings(given: Recording, log: FrameLog, windows: Windows, length: float) -> list[float]:
    """Heading errors [deg] of the published poses shortly after each stall."""
    assert given.truth is not None
    errors = trajectory_errors(log.trajectory(), given.truth)
    out = []
    after = int((length + SETTLED) * SECOND)
    for stamp in windows.begins(given.end - after):
        k = int(np.searchsorted(errors.stamps, stamp + after))
        if k < len(errors.stamps):
            out.append(float(np.degrees(abs(se2.wrap(errors.errors[k, 2])))))
    return out


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study stalls``."""
    parser = subparsers.add_parser(
        'stalls',
        help='odometry that stands still while the robot drives, then catches up',
        description='Simulated drives whose odometry stalls every 9 s, with a 5 Hz laser of 180°.',
    )
    parser.add_argument('--seeds', type=int, default=10, metavar='N', help='default: %(default)s')
    parser.add_argument('--first', type=int, default=0, metavar='SEED', help='the first seed')
    parser.add_argument(
        '--world', nargs='+', default=list(WORLDS), metavar='NAME', help='worlds or world files'
    )
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes (default: 1)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """All worlds and seeds; a row per world."""
    seeds = range(args.first, args.first + args.seeds)
    tasks = [(world, seed, Parameters()) for world in args.world for seed in seeds]
    results: dict[str, dict[int, dict[str, Any]]] = {world: {} for world in args.world}
    with Progress('study', len(tasks), args.json) as progress:
        for k, ((world, seed, _), row) in enumerate(each(evaluate, tasks, args.jobs), 1):
            results[world][seed] = row
            progress.update(k, f'{Path(world).stem}, seed {seed}')
    print(json.dumps(results) if args.json else table(results))
    return 0


def table(results: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> str:
    """A row per world; the worst seeds by name."""
    cells: list[Sequence[str]] = [(
        'world', 'stalls', 'heading error > 2°', 'largest [°]', 'clean largest [°]', 'error/clean',
        'clean [cm]', 'OK and wrong', 'longest [s]', 'LOST', 'CPU/clean', 'worst seeds',
    )]  # fmt: skip
    for world, by_seed in results.items():
        rows = list(by_seed.values())
        headings = np.array([h for r in rows for h in r['headings']])
        total = {k: float(np.mean([r[k] for r in rows])) for k in rows[0] if 'headings' not in k}
        worst = sorted(by_seed, key=lambda seed: -max(by_seed[seed]['headings'], default=0.0))
        cells.append((
            Path(world).stem, str(len(headings)), f'{np.mean(headings > 2.0):.2%}',
            f'{np.max(headings):.1f}',
            f'{max(h for r in rows for h in r["clean_headings"]):.1f}',
            f'{total["mean_m"] / total["clean_m"]:.2f}', f'{100.0 * total["clean_m"]:.1f}',
            f'{total["ok_and_wrong"]:.2%}', f'{max(r["longest_s"] for r in rows):.1f}',
            f'{total["lost"]:.2%}', f'{total["cpu_ms"] / total["clean_cpu_ms"]:.2f}',
            ' '.join(str(s) for s in worst[:5]),
        ))  # fmt: skip
    return aligned(cells)
