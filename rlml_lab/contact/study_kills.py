# SPDX-License-Identifier: Apache-2.0
"""``study kills``: front end, back end or both are killed at random instants while they map, live.

After each kill of the back end its journal must give a map, which may end at most 10 s before the
kill; the front end must go on with poses while there is no back end.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.maps import map_container
from rlml_slam.params import Simulator
from rlml_slam.ros.codecs import decode
from rlml_slam.slam.store import journal, map_file

START = 600.0  # [s] for a process to start, kernels to be compiled included
LOST, RATE = 10.0, 9.0  # [s] of mapping that a kill may cost; [Hz] of poses without a back end
WHOM = ('back_end', 'back_end', 'front_end', 'both')
SECOND = 1e9


@dataclass
class Killed:
    """What the kills have cost."""

    kills: dict[str, int] = field(default_factory=dict)
    maps: int = 0
    unreadable: list[str] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)  # [s] of stamps
    rates: list[float] = field(default_factory=list)  # [Hz] of stamps
    bytes_per_second: list[float] = field(default_factory=list)


class Ear(Node):
    """Hears the poses."""

    def __init__(self) -> None:
        super().__init__('ear')
        self.stamps: list[int] = []
        kind, qos = PoseWithCovarianceStamped, QoSProfile(depth=1000)
        self.create_subscription(kind, 'pose', self.on_pose, qos)

    def on_pose(self, msg: Any) -> None:
        """A pose of the front end."""
        self.stamps.append(decode.stamp(msg, 'pose'))


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study kills``."""
    parser = subparsers.add_parser('kills', help='processes that are killed while they map, live')
    parser.add_argument('--kills', type=int, default=200)
    parser.add_argument('--longest', type=float, default=15.0, help='[s] between two kills')
    parser.add_argument('--seconds', type=float, default=36_000.0, help='after which it ends')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--log', type=Path, default=Path('kills_log'), help='folder of logs')


def run(args: argparse.Namespace) -> int:
    """Kill and count; 1 where more was lost than may be."""
    domain, killed = free_domain(), Killed()
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with (
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        own_domain(domain, environment),
        Processes(args.log, environment) as children,
    ):
        ear, executor = Ear(), SingleThreadedExecutor()
        executor.add_node(ear)
        try:
            _Drive(children, ear, executor, Path(maps), killed).run(args)
        finally:
            executor.shutdown(timeout_sec=1.0)
            ear.destroy_node()
    return report(killed)


def report(of: Killed) -> int:
    """Print the figures; the exit code."""
    print(f'kills: {", ".join(f"{n} of {whom}" for whom, n in sorted(of.kills.items()))}')
    print(f'maps readable: {of.maps - len(of.unreadable)} of {of.maps}')
    print(*of.unreadable, sep='\n')
    if of.lost:
        print(f'lost mapping: median {np.median(of.lost):.1f} s, worst {max(of.lost):.1f} s')
        per_hour = np.median(of.bytes_per_second) * 3600 / 1e6
        print(f'journal: {per_hour:.0f} MB per hour of driving (median)')
    if of.rates:
        print(f'poses without back end: median {np.median(of.rates):.2f} Hz, '
              f'least {min(of.rates):.2f} Hz')  # fmt: skip
    lost, rate = max(of.lost, default=0.0), min(of.rates, default=RATE)
    return int(bool(of.unreadable) or lost > LOST or rate < RATE)


class _Drive:
    def __init__(
        self, children: Processes, ear: Ear, executor: Any, maps: Path, killed: Killed
    ) -> None:
        self._children, self._ear, self._executor = children, ear, executor
        self._maps, self._killed = maps, killed

    def run(self, args: argparse.Namespace) -> None:
        """All kills, one after the other."""
        rng, end = np.random.default_rng(args.seed), time.monotonic() + args.seconds
        for name in ('front_end', 'back_end'):
            self._start(name)
        self._children.start(
            'simulator', node('simulator', {'repeat': 'true', 'wait_for_subscribers': 1})
        )
        for _ in range(args.kills):
            if time.monotonic() > end:
                return
            self._until(lambda: bool(self._journals()), 'no journal was written')
            self._spin(float(rng.uniform(0.0, args.longest)))
            self._kill(str(rng.choice(WHOM)))

    def _start(self, name: str) -> None:
        values = {'map_directory': self._maps, 'laser_pose': list(Simulator().laser_pose)}
        self._children.start(name, node(name, values))

    def _journals(self) -> list[Path]:
        """Journals that are not those of killed processes, which are read and removed."""
        return [f for f in self._maps.glob('map.journal-*[0-9]') if f.stat().st_size]

    def _kill(self, whom: str) -> None:
        self._killed.kills[whom] = self._killed.kills.get(whom, 0) + 1
        names = ('front_end', 'back_end') if whom == 'both' else (whom,)
        newest = self._ear.stamps[-1]
        for name in names:
            self._children.kill(name)
        self._spin(0.2)
        if 'back_end' in names:
            self._look_at(newest)
        count = len(self._ear.stamps)
        for name in names:
            self._start(name)
        if 'front_end' in names:
            self._until(lambda: len(self._ear.stamps) > count + 20, 'no pose came')
            return
        self._until(lambda: bool(self._journals()), 'no journal was written')
        stamps = np.array(self._ear.stamps[count:])
        if len(stamps) > 20:
            self._killed.rates.append((len(stamps) - 1) / float(np.ptp(stamps) / SECOND))

    def _look_at(self, newest: int) -> None:
        """What the journal of a killed back end gives, compared with the newest pose.

        Just after a restart of the front end, the map until then is in a file of its own and the
        new one may have no keyframe yet.
        """
        journals = self._journals()
        if not journals:
            self._killed.maps += 1
            kept = sorted(self._maps.glob('map.lost-*.rlml'))
            try:
                map_file.load(kept[-1])
            except (RlmlError, LookupError) as e:
                self._killed.unreadable.append(f'no journal, and no map is kept: {e}')
        for path in journals:
            self._killed.maps += 1
            try:
                back_end, params = journal.recover(path)
                map_file.content_of(back_end, params, back_end.occupancy_grid())
                pieces = [*map_container.read_pieces(path)][1:]
                stamps = [int(p.arrays['frames']['stamp'][k]) for p in pieces for k in (0, -1)]
            except (RlmlError, LookupError) as e:
                self._killed.unreadable.append(f'{path.name}: {e}')
                continue
            self._killed.lost.append((newest - stamps[-1]) / SECOND)
            driven = max((stamps[-1] - stamps[0]) / SECOND, 1.0)
            self._killed.bytes_per_second.append(path.stat().st_size / driven)
            path.unlink()

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)
        self._children.check('simulator')

    def _until(self, true: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + START
        while not true():
            if time.monotonic() > end:
                raise RlmlError(otherwise)
            self._spin(0.2)
            self._children.check('simulator', 'front_end', 'back_end')
