# SPDX-License-Identifier: Apache-2.0
"""``rlml demo``: simulator, front end and back end as three processes, live over DDS."""

from __future__ import annotations

import argparse
import contextlib
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.cli.support.live_session import LISTENERS, Source, drive
from rlml_slam.evaluation.run_record import Origin
from rlml_slam.params import Simulator
from rlml_slam.report.outputs import make_folder, write_outputs
from rlml_slam.report.summary import print_summary
from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world

RATE = 2.0  # simulated seconds per second: two cores keep up with three processes and a recorder
GYRO_RATE = 50.0  # [Hz] simulated: a higher rate costs CPU time without any gain
STILL = 1.0  # [s] simulated: standing before and after the drive


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml demo``."""
    parser = subparsers.add_parser(
        'demo', help='simulator, front end and back end live over DDS, then a report'
    )
    parser.add_argument(
        '--out', type=Path, default=Path('out/demo'), metavar='DIR', help='default: %(default)s'
    )
    parser.add_argument(
        '--world', default='hall', help='world of the drive (default: %(default)s)'
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of all noise')
    parser.add_argument(
        '--rate', type=float, default=RATE, metavar='X',
        help='simulated seconds per second (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--mcap', metavar='FILE', type=Path,
        help='inputs and all that the nodes publish as one file for Foxglove, RViz and others',
    )  # fmt: skip
    parser.add_argument(
        '--view', type=int, default=8080, metavar='PORT',
        help='watch it at this port of 127.0.0.1 (default: %(default)s; 0: no)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print metrics.json and no more')


def run(args: argparse.Namespace) -> int:
    """Drive, listen, write the results, and say what they are."""
    world = load_world(args.world)
    # a wrong value is refused here, before three processes start
    Simulator(world=args.world, seed=args.seed, rate=args.rate)
    out = make_folder(args.out)
    if not args.json:
        print(
            f'{world.name}: simulator, front end and back end are three processes over DDS, '
            f'at {args.rate:g} × real time',
            flush=True,
        )
    played = replace(source(args, world), view_port=port_of(args))
    if played.view_port and not args.json:
        print(f'watch it at http://127.0.0.1:{played.view_port}/', flush=True)
    result = drive(played, out, args.json)
    result.origin = Origin(args.command_line, played.system)
    return print_summary(result, write_outputs(result, out), out, args.json)


def port_of(args: argparse.Namespace) -> int | None:
    """The port to watch at, the one that was asked for or the next one that is free."""
    for port in range(args.view, args.view + 20) if args.view else ():
        with contextlib.suppress(OSError), socket.create_server(('127.0.0.1', port)):
            return port
    return None


def source(args: argparse.Namespace, world: World) -> Source:
    """The simulator in the place of a robot."""
    length = route_length(world)
    return Source(
        f'{world.name}, live',
        'simulator',
        {
            'world': args.world, 'seed': args.seed, 'rate': float(args.rate),
            'still_time': STILL, 'gyro.rate': GYRO_RATE, 'wait_for_subscribers': LISTENERS,
        },
        lambda recorder: recorder.distance / length,
        # where there is no tf2_msgs, /tf_static has no laser pose
        {'laser_pose': list(Simulator().laser_pose), 'map_update_interval': 1.0},
        keeps_map=True,
        mcap=args.mcap,
    )  # fmt: skip


def route_length(world: World) -> float:
    """Length [m] of the way through the points of the route."""
    steps = np.diff(np.asarray(world.route, dtype=np.float64)[:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())
