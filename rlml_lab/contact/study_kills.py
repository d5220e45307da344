# SPDX-License-Identifier: Apache-2.0
"""``study kills``: front end, back end or both are killed at random instants while they map, live.

After each kill of the back end its journal must give a map, which may end at most 10 s before the
kill, and which the next back end must recover; the front end must go on with poses while there is
no back end. After each kill of the front end, the back end must go on with the map, or have put it
aside in a file. A map so young that it is in no file yet is lost as a whole, which counts as well.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rlml_lab.contact.forked_nodes import ForkedNodes
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import MapError, RlmlError
from rlml_slam.maps import map_container
from rlml_slam.params import Simulator
from rlml_slam.ros.codecs import decode
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.store import journal, map_file

START = 600.0  # [s] for a process to start, kernels to be compiled included
KEPT = 10.0  # [s] in which keyframes follow a restart of the front end, or the map is aside
LOST, RATE = 10.0, 9.0  # [s] of mapping that a kill may cost; [Hz] of poses without a back end
WHOM = {
    'back_end': ('back_end',), 'front_end': ('front_end',), 'both': ('front_end', 'back_end'),
}  # fmt: skip
SECOND = 1e9


@dataclass
class Killed:
    """What the kills have cost, by whom they hit."""

    kills: Counter[str] = field(default_factory=Counter)
    readable: Counter[str] = field(default_factory=Counter)
    young: Counter[str] = field(default_factory=Counter)  # maps that no file had yet
    went_on: int = 0  # maps that went on after a restart of the front end
    unreadable: list[str] = field(default_factory=list)
    lost: dict[str, list[float]] = field(default_factory=lambda: {w: [] for w in WHOM})  # [s]
    rates: list[float] = field(default_factory=list)  # [Hz] of stamps
    bytes_per_second: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, whom: str, lost: float) -> None:
        """A map was readable, but for the last seconds [s] of stamps."""
        self.readable[whom] += 1
        self.lost[whom].append(lost)

    def add_young(self, whom: str, lost: float) -> None:
        """There was no file of a map, all of which [s] is lost."""
        self.young[whom] += 1
        self.lost[whom].append(lost)


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
    parser.add_argument('--kills', type=int, default=600, help='a third of each kind')
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
        Processes(args.log, environment) as source,
        ForkedNodes(args.log / 'nodes', environment) as nodes,
    ):
        ear, executor = Ear(), SingleThreadedExecutor()
        executor.add_node(ear)
        began = time.monotonic()
        try:
            _Drive(source, nodes, ear, executor, Path(maps), killed).run(args)
        except (RlmlError, KeyboardInterrupt) as e:
            killed.unreadable.append(f'ended after {killed.kills.total()} kills: {e}')
        finally:
            executor.shutdown(timeout_sec=1.0)
            ear.destroy_node()
        killed.seconds = time.monotonic() - began
    return report(killed)


def report(of: Killed) -> int:
    """Print the figures; the exit code."""
    kills = of.kills.total()
    print(f'{kills} kills, {of.seconds / max(kills, 1):.1f} s each')
    for whom, n in sorted(of.kills.items()):
        lost = of.lost[whom] or [np.nan]
        print(f'  {whom}: {of.readable[whom]} of {n - of.young[whom]} maps readable, '
              f'{of.young[whom]} too young for a file; lost mapping: '
              f'median {np.median(lost):.1f} s, worst {max(lost):.1f} s')  # fmt: skip
    if n := of.kills['front_end']:
        print(f'  maps that went on after a restart of the front end: {of.went_on} of {n}')
    print(*of.unreadable, sep='\n')
    if of.bytes_per_second:
        per_hour = np.median(of.bytes_per_second) * 3600 / 1e6
        print(f'journal: {per_hour:.0f} MB per hour of driving (median)')
    if of.rates:
        print(f'poses through a restart of the back end: median {np.median(of.rates):.2f} Hz, '
              f'least {min(of.rates):.2f} Hz')  # fmt: skip
    worst = max(seconds for one in of.lost.values() for seconds in [*one, 0.0])
    return int(bool(of.unreadable) or worst > LOST or min(of.rates, default=RATE) < RATE)


class _Drive:
    def __init__(
        self, source: Processes, nodes: ForkedNodes, ear: Ear, executor: Any, maps: Path,
        killed: Killed,
    ) -> None:  # fmt: skip
        self._source, self._nodes, self._ear, self._executor = source, nodes, ear, executor
        self._maps, self._killed = maps, killed
        self._left: set[Path] = set()  # journals of killed processes
        self._began = 0  # stamp of the first pose of the map in the making

    def run(self, args: argparse.Namespace) -> None:
        """All kills, one after the other."""
        rng, end = np.random.default_rng(args.seed), time.monotonic() + args.seconds
        for name in WHOM['both']:
            self._start(name)
        self._source.start(
            'simulator', node('simulator', {'repeat': 'true', 'wait_for_subscribers': 1})
        )
        self._until(lambda: bool(self._ear.stamps), 'no pose came')
        self._began = self._ear.stamps[0]
        for _ in range(args.kills):
            self._spin(float(rng.uniform(0.0, args.longest)))
            if time.monotonic() > end:
                return
            self._kill(str(rng.choice(list(WHOM))))

    def _start(self, name: str) -> None:
        values = {'map_directory': self._maps, 'laser_pose': list(Simulator().laser_pose)}
        self._nodes.start(name, node(name, values))

    def _journals(self) -> list[Path]:
        """Journals that are not those of killed processes."""
        found = self._maps.glob('map.journal-*[0-9]')
        return [f for f in found if f not in self._left and f.stat().st_size]

    def _kill(self, whom: str) -> None:
        self._killed.kills[whom] += 1
        names, newest, before = WHOM[whom], self._ear.stamps[-1], len(self._ear.stamps)
        self._nodes.kill(*names)
        self._spin(0.2)
        if 'back_end' in names:
            self._read_journals(whom, newest)
        count = len(self._ear.stamps)
        for name in names:
            self._start(name)
        self._until(lambda: len(self._ear.stamps) > count + 20, 'no pose came')
        if whom == 'front_end':
            self._read_kept(newest)
        else:
            self._began = self._ear.stamps[count]
        if 'back_end' in names:
            self._until(lambda: not any(f.exists() for f in self._left), 'no map was recovered')
            self._read_recovered()
        if whom == 'back_end':
            stamps = np.array(self._ear.stamps[before - 1 :])
            self._killed.rates.append((len(stamps) - 1) / float(np.ptp(stamps) / SECOND))

    def _read_journals(self, whom: str, newest: int) -> None:
        """What the journal of a killed back end gives, compared with the newest pose."""
        journals = self._journals()
        if not journals:
            self._killed.add_young(whom, (newest - self._began) / SECOND)
        for path in journals:
            try:
                back_end, params = journal.recover(path)
                map_file.content_of(back_end, params, back_end.occupancy_grid())
                stamps = _stamps(path)
            except (RlmlError, LookupError) as e:
                self._killed.unreadable.append(f'{path.name}: {e}')
                continue
            self._killed.add(whom, (newest - stamps[-1]) / SECOND)
            driven = max((stamps[-1] - stamps[0]) / SECOND, 1.0)
            self._killed.bytes_per_second.append(path.stat().st_size / driven)
        self._left |= set(journals)

    def _read_kept(self, newest: int) -> None:
        """The map after a restart of the front end alone: the back end's own, or one put aside."""
        end = time.monotonic() + KEPT
        while not (aside := [*self._maps.glob('map.lost-*.rlml')]) and time.monotonic() < end:
            if any(stamp > newest for stamp in self._running_stamps()):
                break
            self._spin(0.1)
        try:
            kept = [_last_stamp(path) for path in aside]
        except (RlmlError, LookupError) as e:
            self._killed.unreadable.append(f'a map put aside: {e}')
            return
        for path in aside:
            path.unlink()
        now = self._running_stamps()
        kept += [stamp for stamp in now if stamp <= newest]
        if not kept:
            self._killed.add_young('front_end', (newest - self._began) / SECOND)
        else:
            self._killed.add('front_end', (newest - max(kept)) / SECOND)
        later = [stamp for stamp in now if stamp > newest]
        if aside or not kept:
            self._began = min(later, default=newest)
        elif later:
            self._killed.went_on += 1

    def _running_stamps(self) -> list[int]:
        """Stamps in the journal of the back end that runs; it may end one meanwhile."""
        try:
            return [stamp for path in self._journals() for stamp in _stamps(path)]
        except (OSError, MapError):
            return []

    def _read_recovered(self) -> None:
        """The maps that the next back end has made of the journals."""
        made = [*self._maps.glob('map.autosave-*.rlml')]
        if len(made) != len(self._left):
            bad = [f.name for f in self._maps.glob('*.damaged')]
            self._killed.unreadable.append(f'{len(made)} of {len(self._left)} recovered; {bad}')
        for path in made:
            try:
                _last_stamp(path)
            except (RlmlError, LookupError) as e:
                self._killed.unreadable.append(f'{path.name}: {e}')
            path.unlink()
        self._left.clear()

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)
        self._source.check('simulator')

    def _until(self, true: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + START
        while not true():
            if time.monotonic() > end:
                raise RlmlError(otherwise)
            self._spin(0.2)
            self._nodes.check()


def _stamps(path: Path) -> list[int]:
    """Stamps of the frames in a journal."""
    pieces = [p for p in map_container.read_pieces(path) if 'frames' in p.arrays]
    return [int(stamp) for p in pieces for stamp in p.arrays['frames']['stamp']]


def _last_stamp(path: Path) -> int:
    """Stamp of the last keyframe of a map."""
    content = map_file.load(path)
    back_end = BackEnd(map_file.parameters_of(content))
    map_file.restore(content, back_end)
    return int(back_end.keyframes[-1].stamp)
