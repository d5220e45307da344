# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench front-end``: CPU time per scan, from the message to the pose, against yag-slam.

Both get the same scans in one run, each scan the one right after the other. Ours includes all that
comes between two scans: odometry, IMU and reflectors. The rival, a port of Karto's scan matcher in
C++ at its own default settings, is spared the loop closures, and is given a scan only after the
robot has moved, as its users do.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2, warm_up
from rlml_slam.errors import RlmlError
from rlml_slam.evaluation.metrics import distribution
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Detections, Imu, Observation, Odometry, Scan

WARM = 50  # scans of each that are not counted
MOVED = (0.2, 0.2)  # [m], [rad] between two scans that the rival is given
Input = Callable[[], list[Observation]]
Case = tuple[str, Iterator[Input]]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench front-end``."""
    parser = subparsers.add_parser(
        'front-end',
        help='CPU time per scan against a scan matcher',
        description='Drives through a simulated hall with reflectors, and bags. Compares with '
        "yag-slam where it is installed (pip install '.[bench]').",
    )
    parser.add_argument('bags', nargs='*', metavar='BAG', type=Path, help='logs to run as well')
    parser.add_argument(
        '--scans', type=int, default=3000, help='of each at most (default: %(default)s)'
    )
    parser.add_argument(
        '--beams', type=int, default=1440, help='in the hall (default: %(default)s)'
    )
    parser.add_argument('--without', action='append', default=[], help='leave out a library')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    if args.scans <= WARM:
        raise RlmlError(f'--scans {args.scans}: the first {WARM} are not counted')
    warm_up.compile_loaded()
    with_rival = 'yag-slam' not in args.without and importlib.util.find_spec('yag_slam')
    results = []
    for bag in args.bags:
        with BagReader(bag) as reader:
            name = bag.resolve().name
            results.append(measure(name, from_bag(reader), args.scans, bool(with_rival)))
    case = from_hall(args.beams)
    results.append(measure('hall', case, args.scans, bool(with_rival)))
    print(json.dumps({'results': results}) if args.json else text(results))
    return 0


def from_bag(bag: BagReader) -> Iterator[Input]:
    """The inputs of a bag."""
    params = Parameters()
    inputs, synchronizer = BagInputs(bag, params), Synchronizer(params)
    feed = SensorInput(params, synchronizer, synchronizer.inputs)
    feed.use_extrinsics(inputs.extrinsics)
    for _, stream, message in inputs:
        yield partial(feed.add, stream, message)


def from_hall(beams: int) -> Iterator[Input]:
    """The inputs of a drive through the demo's hall, as often along its route as it takes."""
    p: SimulatorParameters = from_mapping(
        {'world': 'hall', 'laser.beams': beams, 'repeat': True}, SimulatorParameters
    )
    synchronizer = Synchronizer(Parameters())
    synchronizer.set_sensor_pose(p.node.laser_frame, np.array(p.node.laser_pose))
    add: dict[type[Any], Callable[[Any], list[Observation]]] = {
        Odometry: synchronizer.add_odometry,
        Imu: synchronizer.add_imu,
        Scan: synchronizer.add_scan,
        Detections: synchronizer.add_detections,
    }
    for event in Simulation(load_world('hall'), p):
        if type(event.message) in add:
            yield partial(add[type(event.message)], event.message)


def measure(name: str, inputs: Iterator[Input], scans: int, with_rival: bool) -> dict[str, Any]:
    """Figures of one case: CPU times [ms] of ``rlml`` and, where it is there, ``yag_slam``."""
    front_end = FrontEnd(Parameters())
    rival = Rival() if with_rival else None
    ours: list[float] = []
    theirs: list[float] = []
    beams, most, spent = 0, 0, 0.0
    for add in inputs:
        ms, observations = cpu_ms(lambda add=add: process(add, front_end))  # type: ignore[misc]
        spent += ms
        for o in observations:
            most = max(most, 0 if o.detections is None else len(o.detections))
            if o.scan is None:
                continue
            beams = len(o.scan.ranges)
            ours.append(spent)
            spent = 0.0
            if rival is not None and rival.wants(o):
                theirs.append(cpu_ms(partial(rival.add, o))[0])
        if len(ours) >= scans:
            break
    if len(ours) <= WARM:
        raise RlmlError(f'{name}: {len(ours)} scans are too few')
    result = {
        'case': name,
        'beams': beams,
        'reflectors_at_most': most,
        'scans': len(ours) - WARM,
        'rlml': distribution(ours[WARM:]),
        'yag_slam': distribution(theirs[WARM:]),
        'yag_slam_scans': max(len(theirs) - WARM, 0),
        'ratio': None,
    }
    if len(theirs) > WARM:
        result['ratio'] = round(float(np.median(ours[WARM:]) / np.median(theirs[WARM:])), 3)
    return result


def process(add: Input, front_end: FrontEnd) -> list[Observation]:
    """One message through sequencer and front end; the observations that became ready."""
    observations = add()
    for observation in observations:
        front_end.process(observation)
    return observations


def cpu_ms(call: Callable[[], Any]) -> tuple[float, Any]:
    """(CPU time of the process in ms, result)."""
    start = time.process_time()
    result = call()
    return (time.process_time() - start) * 1e3, result


class Rival:
    """yag-slam's sequential scan matching: its matcher in C++, against the last ten scans.

    The loop is that of its GraphSlam.process_scan, which itself cannot be imported without
    OpenCV, and which would add its graph to the time.
    """

    def __init__(self) -> None:
        from karto_scanmatcher import Wrapper
        from yag_slam.helpers import make_config

        self._matcher = Wrapper(make_config({}))
        self._running: deque[Any] = deque(maxlen=10)
        self._at: Array = np.zeros(3)  # odometry of the last scan
        self._last: Array | None = None

    def wants(self, observation: Observation) -> bool:
        """Whether the robot has moved since the scan before."""
        pose = observation.odom_pose
        if pose is None:
            return False
        if self._last is not None:
            step = se2.between(self._last, pose)
            if math.hypot(step[0], step[1]) < MOVED[0] and abs(step[2]) < MOVED[1]:
                return False
        self._last = pose
        return True

    def add(self, observation: Observation) -> None:
        """Match one scan from where odometry says that it is."""
        from karto_scanmatcher import LaserScanConfig, LocalizedRangeScan, Pose2

        scan, T_base_laser = observation.scan, observation.T_base_laser
        assert scan is not None
        assert T_base_laser is not None
        assert observation.odom_pose is not None
        odometry = guess = se2.compose(observation.odom_pose, T_base_laser)
        if self._running:
            before = self._running[-1].corrected_pose
            at = np.array([before.x, before.y, before.yaw])
            guess = se2.compose(at, se2.between(self._at, odometry))
        self._at = odometry
        n = len(scan.ranges)
        no_return = 2.0 * scan.range_max  # it cannot bear NaN
        config = LaserScanConfig(
            scan.angle_min, scan.angle_min + (n - 1) * scan.angle_increment, scan.angle_increment,
            scan.range_min, scan.range_max, min(20.0, scan.range_max), '',
        )  # fmt: skip
        query = LocalizedRangeScan(
            config,
            np.nan_to_num(scan.ranges, nan=no_return, posinf=no_return).tolist(),
            Pose2(*odometry.tolist()),
            Pose2(*guess.tolist()),
            0,
            0.0,
        )
        if self._running:
            found = self._matcher.match_scan(query, list(self._running), True, True)
            query.corrected_pose = found.best_pose
        self._running.append(query)


def text(results: list[dict[str, Any]]) -> str:
    """The figures for people."""
    rows = [
        'CPU time per scan [ms]',
        f'{"case":16}{"beams":>6}{"reflectors":>11}{"scans":>7}{"median":>9}{"p99":>8}'
        f'{"yag-slam":>11}{"p99":>8}{"ratio":>7}',
    ]
    for r in results:
        row = (
            f'{r["case"]:16}{r["beams"]:6d}{r["reflectors_at_most"]:11d}{r["scans"]:7d}'
            f'{r["rlml"]["median"]:9.2f}{r["rlml"]["p99"]:8.2f}'
        )
        if r['ratio'] is not None:
            rival = r['yag_slam']
            row += f'{rival["median"]:11.2f}{rival["p99"]:8.2f}{r["ratio"]:7.3f}'
        else:
            row += f'{"not measured":>19}'
        rows.append(row)
    return '\n'.join(rows)
