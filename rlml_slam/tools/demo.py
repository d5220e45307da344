# SPDX-License-Identifier: Apache-2.0
"""``rlml demo``: simulator, front end and back end as three processes, live over DDS."""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import rclpy.utilities
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from rlml_slam.errors import RlmlError
from rlml_slam.params import Simulator
from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world
from rlml_slam.tools.metrics import distribution
from rlml_slam.tools.outputs import make_folder, write_outputs
from rlml_slam.tools.processes import Processes, free_domain
from rlml_slam.tools.progress import Progress
from rlml_slam.tools.record import Run
from rlml_slam.tools.recorder import Recorder
from rlml_slam.tools.summary import summary_text

RATE = 2.0  # simulated seconds per second: two cores keep up with three processes and a recorder
GYRO_RATE = 50.0  # [Hz] simulated: more would cost CPU time and tell nothing new
STILL = 3.0  # [s] simulated: standing at the end, in which the last map is published
START_TIMEOUT = 60.0  # [s] for three processes to start and to find each other
SILENCE = 15.0  # [s] without a pose while the simulator runs: something is broken
LISTENERS = 2  # of the scan: front end and recorder


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
    parser.add_argument('--json', action='store_true', help='print metrics.json and no more')


def run(args: argparse.Namespace) -> int:
    """Drive, listen, write the results, and say what they are."""
    world = load_world(args.world)
    # a wrong value is refused here, before three processes start
    Simulator(world=args.world, seed=args.seed, rate=args.rate, still_time=STILL)
    out = make_folder(args.out)
    if not args.json:
        print(
            f'{world.name}: simulator, front end and back end are three processes over DDS, '
            f'at {args.rate:g} × real time'
        )
    result = live(args, out, world)
    figures = write_outputs(result, out)
    if args.json:
        print(json.dumps(figures))
    else:
        print(summary_text(result.name, figures))
        print(f'report: {out / "report.html"}')
    return 0


@contextmanager
def held_interrupts() -> Iterator[Callable[[], None]]:
    """SIGINT and SIGTERM are held until the yielded function is called; it raises the interrupt.

    Raised anywhere, it could strike while a child is being started, which nobody would end then.
    """
    caught: list[int] = []

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(n, lambda number, _frame: caught.append(number)) for n in numbers]
    try:
        yield check
    finally:
        for n, handler in zip(numbers, before, strict=True):
            signal.signal(n, handler)


def live(args: argparse.Namespace, out: Path, world: World) -> Run:
    """One drive over DDS, heard from outside."""
    domain = free_domain()
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    os.environ.update(environment)
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with held_interrupts() as check, Processes(out / 'log', environment) as processes:
            recorder = Recorder()
            executor = SingleThreadedExecutor()
            executor.add_node(recorder)
            try:
                start(processes, args)
                with Progress('driving', route_length(world), args.json) as progress:
                    for _ in listen(processes, recorder, executor):
                        check()
                        progress.update(recorder.distance, recorder.note())
                memory = [processes.peak_rss_mb(name) for name in ('front_end', 'back_end')]
            finally:
                executor.shutdown(timeout_sec=1.0)
                recorder.destroy_node()
    finally:
        rclpy.utilities.try_shutdown()
    result = recorder.run(f'{world.name}, live')
    result.extra = live_figures(recorder, memory)
    return result


def start(processes: Processes, args: argparse.Namespace) -> None:
    """The three nodes; the simulator waits until the others listen."""
    laser_pose = list(Simulator().laser_pose)
    system = {'laser_pose': laser_pose, 'map_update_interval': 1.0}
    processes.start('front_end', node('front_end', system))
    processes.start('back_end', node('back_end', system))
    driven = {
        'world': args.world, 'seed': args.seed, 'rate': float(args.rate),
        'still_time': STILL, 'gyro.rate': GYRO_RATE, 'wait_for_subscribers': LISTENERS,
    }  # fmt: skip
    processes.start('simulator', node('simulator', driven))


def node(name: str, parameters: Mapping[str, Any]) -> list[str]:
    """Arguments of ``python -m`` for an executable of this package."""
    words = [f'rlml_slam.nodes.{name}', '--ros-args', '--log-level', 'warn']
    for key, value in parameters.items():
        words += ['-p', f'{key}:={value}']
    return words


def listen(
    processes: Processes, recorder: Recorder, executor: SingleThreadedExecutor
) -> Iterator[None]:
    """Hear the whole drive, bit by bit; RlmlError if a process dies or falls silent."""
    began = time.monotonic()
    finished: float | None = None
    while finished is None or not recorder.has_caught_up(finished):
        executor.spin_once(timeout_sec=0.1)
        now = time.monotonic()
        recorder.is_ready()
        processes.check('front_end', 'back_end')
        if finished is None and processes.has_ended('simulator'):
            finished = now
        if not recorder.frames.stamps and now - began > START_TIMEOUT:
            raise RlmlError(f'no pose within {START_TIMEOUT:g} s of the start')
        if finished is None and recorder.silence(now) > SILENCE:
            raise RlmlError(f'the front end has been silent for {SILENCE:g} s')
        yield


def route_length(world: World) -> float:
    """Length [m] of the way through the points of the route."""
    steps = np.diff(np.asarray(world.route, dtype=np.float64)[:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def live_figures(recorder: Recorder, memory: Sequence[float | None]) -> dict[str, Any]:
    """What only a live run has: scans sent, and the time from a scan to its pose."""
    figures: dict[str, Any] = {
        'scans_published': recorder.scans,
        'back_end_inputs': recorder.inputs('back_end'),
    }
    if recorder.latency_ms:
        figures['latency_ms'] = distribution(recorder.latency_ms)
    known = [mb for mb in memory if mb is not None]
    if known:
        figures['peak_rss_mb'] = round(sum(known), 1)
    return figures
