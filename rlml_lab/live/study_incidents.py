# SPDX-License-Identifier: Apache-2.0
"""``study incidents``: robots that are carried away live, and what their black boxes wrote.

Each drive has to leave exactly one file, and a replay of the file has to be LOST at the scan at
which the live run was.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rlml_slam import Slam, read_bag
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.params import Parameters, Simulator
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.types import Level

DURATION, KIDNAPPED = 34.0, 24.0  # [s] of simulated time; the robot has seen the room by then
AFTER = 2.0  # [s] that the file goes on
END = 120.0  # [s] for a drive
LASER = tuple(Simulator().laser_pose)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``rlml-lab study incidents``."""
    parser = subparsers.add_parser('incidents', help='kidnapped robots and their black boxes')
    parser.add_argument('--kidnaps', type=int, default=50, help='(default: %(default)s)')
    parser.add_argument('--rate', type=float, default=2.0, help='of the simulator')


def run(args: argparse.Namespace) -> int:
    """One line for each drive; 1 where a file is missing, twice there, or LOST elsewhere."""
    good = 0
    for seed in range(args.kidnaps):
        with tempfile.TemporaryDirectory(prefix='rlml_map_') as folder:
            files = drive(Path(folder), seed, args.rate)
            scans = [apart(path) for path in files]
        is_good = len(files) == 1 and scans[0] is not None and abs(scans[0]) <= 1
        good += is_good
        print(f'  drive {seed}: {len(files)} files, LOST apart by {scans} scans', flush=True)
    print(f'{good} of {args.kidnaps}')
    return int(good < args.kidnaps)


def drive(folder: Path, seed: int, rate: float) -> list[Path]:
    """The incidents of one drive."""
    domain = free_domain()
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with own_domain(domain, environment), Processes(folder / 'log', environment) as children:
        maps = folder / 'maps'
        values = {'map_directory': maps, 'laser_pose': list(LASER), 'incident.after': AFTER}
        children.start('slam', node('slam', values))
        distance = float(np.random.default_rng(seed).uniform(-11.0, -7.0))
        simulated = {
            'world': 'room', 'duration': DURATION, 'kidnap_time': KIDNAPPED, 'seed': seed,
            'kidnap_distance': distance, 'rate': rate, 'wait_for_subscribers': 1,
        }  # fmt: skip
        children.start('simulator', node('simulator', simulated))
        end = time.monotonic() + END
        while not children.has_ended('simulator') and time.monotonic() < end:
            children.check('slam')
            time.sleep(0.2)
        time.sleep(AFTER + 1.0)
        children.stop()
        return sorted((maps / 'incidents').glob('*.mcap'))


def apart(path: Path) -> int | None:
    """By how many scans the replay is LOST later than the live run; None if one never is."""
    params = Parameters()
    params = replace(params, node=replace(params.node, laser_pose=LASER))
    with BagReader(path) as bag:
        poses = [decode.stamp(m, 'pose') for _, _, m in bag.messages(['/pose'])]
        levels = [int(m.level) for _, _, m in bag.messages(['/front_end/health'])]
    slam = Slam(params)
    replayed = [
        (f.stamp, int(f.health.level)) for m in read_bag(path, params) for f in slam.add(m)
    ]
    live = next(first_lost(zip(poses, levels, strict=True)), None)
    again = next(first_lost(replayed), None)
    if live is None or again is None:
        return None
    return int(np.searchsorted(poses, again) - np.searchsorted(poses, live))


def first_lost(frames: Iterator[tuple[int, int]] | list[tuple[int, int]]) -> Iterator[int]:
    """Stamps at which a robot that knew where it was is LOST."""
    was_good = False
    for stamp, level in frames:
        if level == Level.LOST and was_good:
            yield stamp
        was_good = level < Level.LOST
