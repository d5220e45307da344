# SPDX-License-Identifier: Apache-2.0
"""``study incidents``: robots that are carried away live, and what their black boxes wrote.

``kidnaps``: each drive in a saved map has to leave exactly one file, and a replay of the file has
to be LOST at the scan at which the live run was. Where the scan fits the map by chance, a robot is
DEGRADED and never LOST; the replay has to be so as well, from the same scan on. ``kills``: a
process that writes a file is killed at random instants; what is left is a readable file or none.
``cost``: what it takes to record a laser of 40 Hz and 1440 beams.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shutil
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rlml_slam.cli.main import main as rlml
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.params import Parameters, Simulator
from rlml_slam.recordings.bag_replay import Given, replay
from rlml_slam.recordings.incident import about, recorded_parameters
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.front_end import incident_file
from rlml_slam.ros.front_end.black_box import BlackBox
from rlml_slam.ros.front_end.incident import Received
from rlml_slam.slam.store import map_file
from rlml_slam.types import Frame, Health, Level, Motion, Observation

ROOT = Path(__file__).resolve().parents[2]
PARTS = ('kidnaps', 'kills', 'cost')
KIDNAPPED, AFTERWARDS = (5.0, 7.0), 12.0  # [s] of simulated time, ended by the file
DISTANCE = (6.0, 10.0)  # [m] along the route
BEFORE, AFTER = 20.0, 1.0  # [s] around an incident that are written
DEGRADED = 4.0  # [s] after which it is one
END = 120.0  # [s] for a drive
LASER = tuple(Simulator().laser_pose)
HZ, BEAMS = {'/scan': 40, '/odom': 50, '/imu': 100}, 1440
SECONDS = 100  # of recorded time whose cost is measured
SECOND = 1_000_000_000


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``rlml-lab study incidents``."""
    parser = subparsers.add_parser('incidents', help='kidnapped robots and their black boxes')
    parser.add_argument('--kidnaps', type=int, default=50, help='(default: %(default)s)')
    parser.add_argument('--kills', type=int, default=50, help='(default: %(default)s)')
    parser.add_argument('--rate', type=float, default=1.0, help='of the simulator')
    parser.add_argument('--only', choices=PARTS, nargs='+', default=PARTS)


def run(args: argparse.Namespace) -> int:
    """Print each part; 1 where one does not hold."""
    good = True
    if 'cost' in args.only:
        good &= cost()
    if 'kills' in args.only:
        good &= kills(args.kills)
    if 'kidnaps' in args.only:
        good &= kidnaps(args.kidnaps, args.rate)
    return int(not good)


# --- kidnaps -------------------------------------------------------------------------------------


def kidnaps(count: int, rate: float) -> bool:
    """One line for each drive; whether each has one file that is LOST where the robot was."""
    good, kinds = 0, Counter[str]()
    with tempfile.TemporaryDirectory(prefix='rlml_map_') as name:
        folder = Path(name)
        rlml(['replay', str(ROOT / 'bags' / 'room'), '--out', str(folder / 'map'), '--json'])
        file = folder / 'map' / 'map.rlml'
        map_id = map_file.load(file).description['id']
        for seed in range(count):
            began = time.monotonic()
            files = drive(folder / str(seed), file, seed, rate)
            found = [apart(path, file) for path in files]
            scans = [k for _, k in found]
            ids = [(about(path) or {}).get('map_id') for path in files]
            is_good = ids == [map_id] and scans[0] is not None and abs(scans[0]) <= 1
            good += is_good
            kinds.update(level for level, _ in found)
            names = ', '.join(p.name for p in files)
            print(
                f'  drive {seed}: {len(files)} files ({names}), apart by {scans} scans, '
                f'{time.monotonic() - began:.0f} s{"" if is_good else " WRONG"}', flush=True,
            )  # fmt: skip
            if is_good:
                shutil.rmtree(folder / str(seed))
    print(f'kidnaps: {good} of {count}; live {dict(kinds)}')
    return good == count


def drive(folder: Path, file: Path, seed: int, rate: float) -> list[Path]:
    """The incidents of one drive in the map of a file."""
    domain, rng = free_domain(), np.random.default_rng(seed)
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    maps = folder / 'maps'
    maps.mkdir(parents=True)
    shutil.copy(file, maps / 'map.rlml')
    with own_domain(domain, environment), Processes(folder / 'log', environment) as children:
        values = {
            'map_directory': maps, 'laser_pose': list(LASER), 'mode': 'localization',
            'incident.before': BEFORE, 'incident.after': AFTER,
            'incident.degraded_time': DEGRADED,
        }  # fmt: skip
        children.start('slam', node('slam', values))
        at = float(rng.uniform(*KIDNAPPED))
        simulated = {
            'world': 'room', 'duration': at + AFTERWARDS, 'kidnap_time': at, 'seed': seed,
            'kidnap_distance': float(rng.uniform(*DISTANCE)), 'rate': rate,
            'laser.beams': 360, 'wait_for_subscribers': 1,
        }  # fmt: skip
        children.start('simulator', node('simulator', simulated))
        end = time.monotonic() + END
        while not children.has_ended('simulator') and time.monotonic() < end:
            children.check('slam')
            if list((maps / 'incidents').glob('*.mcap')):
                break
            time.sleep(0.1)
        time.sleep(AFTER)
        children.stop()
        return sorted((maps / 'incidents').glob('*.mcap'))


def apart(path: Path, file: Path) -> tuple[str, int | None]:
    """The worst level of the live run, and by how many scans the replay reaches it later.

    None if it never does, or gets worse.
    """
    with BagReader(path) as bag:
        poses = [decode.stamp(m, 'pose') for _, _, m in bag.messages(['/pose'])]
        levels = [int(m.level) for _, _, m in bag.messages(['/front_end/health'])]
    known = map_file.saved_map(map_file.load(file))
    frames = replay(path, recorded_parameters(path) or Parameters(), given=Given(known)).frames
    again = list(zip(frames.stamps, frames.levels, strict=True))
    live = list(zip(poses, levels, strict=True))
    for level in (Level.LOST, Level.DEGRADED):
        first, second = first_at(live, level), first_at(again, level)
        if first is not None and second is not None:
            return level.name, int(np.searchsorted(poses, second) - np.searchsorted(poses, first))
        if first is not None or second is not None:
            return level.name, None
    return Level.OK.name, None


def first_at(frames: list[tuple[int, int]], level: Level) -> int | None:
    """Stamp at which a robot that was better first has the level."""
    was_good = False
    for stamp, found in frames:
        if found >= level and was_good:
            return stamp
        was_good = found < level
    return None


# --- kills ---------------------------------------------------------------------------------------


def kills(count: int) -> bool:
    """Kill a writing process ``count`` times; whether each left a whole file or none."""
    data = [Received(k, '/odom', 'nav_msgs/msg/Odometry', bytes(700)) for k in range(1, 20_000)]
    rng, left = np.random.default_rng(0), Counter[str]()
    fork = multiprocessing.get_context('fork')
    with tempfile.TemporaryDirectory() as name:
        began = time.monotonic()
        incident_file.write(Path(name) / 'whole.mcap', {}, [], data, [], Parameters())
        takes = time.monotonic() - began
        for k in range(count):
            path = Path(name) / f'incident-{k}.mcap'
            child = fork.Process(
                target=incident_file.write, args=(path, {}, [], data, [], Parameters())
            )
            child.start()
            time.sleep(float(rng.uniform(0.0, 1.3 * takes)))
            child.kill()
            child.join()
            left[_found(path, len(data))] += 1
    print(f'kills: {count} while a file was written: {dict(left)}')
    return left['broken'] == 0


def _found(path: Path, count: int) -> str:
    if not path.exists():
        return 'none'
    with BagReader(path) as bag:
        whole = not bag.damage and sum(1 for _ in bag.serialized(['/odom'])) == count
    return 'whole' if whole else 'broken'


# --- cost ----------------------------------------------------------------------------------------


def cost() -> bool:
    """Processor time of recording per second of data, and of writing; whether it is below 3 %."""
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import Imu, LaserScan

    kinds = {'/scan': LaserScan, '/odom': Odometry, '/imu': Imu}
    sizes = {'/scan': 100 + 8 * BEAMS, '/odom': 720, '/imu': 340}
    data = {topic: bytes([0, 1, 0, 0]) + bytes(size) for topic, size in sizes.items()}
    events = sorted((k / hz, topic) for topic, hz in HZ.items() for k in range(SECONDS * hz))
    with tempfile.TemporaryDirectory() as name, ExitStack() as exits:
        params = Parameters()
        params = replace(params, node=replace(params.node, map_directory=name))
        clock = [0]
        box = _Box(_node(exits), params, clock)
        began = time.process_time()
        for at, topic in events:
            clock[0] = int(at * SECOND)
            box.tap(topic, kinds[topic], data[topic])
            box.arrange(list(HZ))
            if topic == '/scan':
                box.follow(_frame(clock[0]))
        spent = time.process_time() - began
        began = time.process_time()
        for at, topic in events:
            if topic == '/scan':
                _frame(int(at * SECOND))
        spent -= time.process_time() - began  # of the frames, which the node makes anyway
        began = time.process_time()
        _node_answer = SimpleNamespace()
        box.on_request(None, _node_answer)
        exits.close()
        written = time.process_time() - began
        (path,) = Path(name).rglob('*.mcap')
        size = path.stat().st_size / 1e6
    share = spent / SECONDS
    print(
        f'cost: {share:.2%} of a core at 40 Hz x {BEAMS} beams; writing {size:.0f} MB takes '
        f'{written:.2f} s of processor time'
    )
    return share <= 0.03


class _Box(BlackBox):
    """A black box with a clock of its own."""

    def __init__(self, node: Any, params: Parameters, clock: list[int]) -> None:
        self._clock = clock
        super().__init__(node, params)

    def _now(self) -> int:
        return self._clock[0]


def _node(exits: ExitStack) -> Any:
    """What a black box needs of a node."""
    quiet = SimpleNamespace(**dict.fromkeys(('warning', 'error', 'info'), lambda text: None))
    nothing = {name: lambda *args: None for name in ('every', 'create_service')}
    return SimpleNamespace(get_logger=lambda: quiet, exits=exits, **nothing)


def _frame(stamp: int) -> Frame:
    pose, cov, none = np.zeros(3), np.eye(3), np.zeros(0, np.int64)
    observation = Observation(stamp, Motion(pose, cov))
    return Frame(stamp, observation, pose, cov, pose, cov, none, none, Health())
