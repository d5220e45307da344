# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench live``: whether the live nodes keep up with a fast laser, over DDS.

The simulator, a process of its own, publishes scans, odometry, IMU and reflectors in real time.
Every scan has to get its pose; a scan is late where its pose had been given before it came.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.live_session import LISTENERS, SYSTEM, Source, drive
from rlml_slam.errors import RlmlError
from rlml_slam.evaluation.metrics import metrics
from rlml_slam.params import Laser, Simulator
from rlml_slam.simulation.world_file import load_world

ALSO_USED = ('waited_out', 'no_returns', 'robot_parts', 'sweep_time')  # counted beside `used`
START = 10.0  # [s] at least: a shorter run is not significant
MOTION_HZ = 100.0  # of odometry and IMU: a scan waits for the odometry at its end


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench live``."""
    parser = subparsers.add_parser(
        'live',
        help='whether the live nodes keep up with a fast laser',
        description='Simulator and system as processes of their own over DDS, in real time: '
        'odometry and IMU at 100 Hz, reflectors and scans at the rate of the laser.',
    )
    parser.add_argument('--minutes', type=float, default=1.0, help='default: %(default)s')
    parser.add_argument('--hz', type=float, default=40.0, help='scans (default: %(default)s)')
    parser.add_argument('--beams', type=int, default=1440, help='per scan (default: %(default)s)')
    parser.add_argument('--world', default='hall', help='default: %(default)s')
    parser.add_argument(
        '--rate', type=float, default=1.0, metavar='X',
        help='simulated seconds per second (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--processes', type=int, choices=(1, 2), default=2,
        help='1: slam, 2: front_end and back_end (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Drive for a while and print what became of the scans."""
    duration = 60.0 * args.minutes * args.rate
    if not duration >= START:
        raise RlmlError(f'--minutes {args.minutes:g} gives less than {START:g} s')
    # a wrong value is refused here, before three processes start
    load_world(args.world)
    Simulator(world=args.world, rate=args.rate, duration=duration)
    Laser(rate=args.hz, beams=args.beams)
    with tempfile.TemporaryDirectory() as folder:
        result = drive(source(args, duration, folder), Path(folder), args.json)
    figures = metrics(result)
    scans = figures['inputs'].get('scan', {})
    arrived = sum(n for what, n in scans.items() if what not in ALSO_USED)
    out = {
        'scans_sent': figures['scans_published'],
        'poses': figures['scans'],
        'dropped': figures['scans_published'] - arrived,
        'late': scans.get('late', 0),
        'latency_ms': figures.get('latency_ms'),
        'front_end_ms': figures['front_end_ms'],
        'back_end_ms': figures['back_end_ms'],
        'nodes': figures.get('nodes', {}),
        'inputs': figures['inputs'],
        'seconds': figures['wall_s'],
        'live_ate_rmse_m': figures.get('live_ate_rmse_m'),
    }
    print(json.dumps(out) if args.json else text(out))
    return 0


def source(args: argparse.Namespace, duration: float, folder: str) -> Source:
    """The simulator, which drives its route again and again; the map is saved in ``folder``."""
    return Source(
        'bench',
        'simulator',
        {
            'world': args.world, 'rate': float(args.rate), 'duration': duration, 'repeat': True,
            'laser.rate': float(args.hz), 'laser.beams': args.beams, 'wheels.rate': MOTION_HZ,
            'gyro.rate': MOTION_HZ,
            'wait_for_subscribers': LISTENERS,
        },
        lambda recorder: recorder.elapsed() / duration,
        nodes=SYSTEM if args.processes == 2 else ('slam',),
        system={'laser_pose': list(Simulator().laser_pose), 'map_directory': folder},
    )  # fmt: skip


def text(figures: dict[str, Any]) -> str:
    """The figures for people."""
    rows = [
        f'{figures["scans_sent"]} scans sent, {figures["poses"]} poses received, '
        f'{figures["dropped"]} scans dropped, {figures["late"]} late'
    ]
    for name, key in (
        ('scan to pose', 'latency_ms'),
        ('front end per scan', 'front_end_ms'),
        ('back end per keyframe', 'back_end_ms'),
    ):
        ms = figures[key]
        if ms and ms['median'] is not None:
            rows.append(
                f'{name}: median {ms["median"]:.1f} ms, p99 {ms["p99"]:.1f}, max {ms["max"]:.1f}'
            )
    for name, n in figures['nodes'].items():
        growth = n['rss_growth_mb_per_min']
        rows.append(
            f'{name}: {n["cpu_share"]:.0%} of one core, {n["peak_rss_mb"]:.0f} MB'
            + ('' if growth is None else f', growing by {growth:.2f} MB per minute')
        )
    return '\n'.join(rows)
