# SPDX-License-Identifier: Apache-2.0
"""``study live-load``: a saved map is loaded while the robot drives and maps, again and again.

A load is good where the map is entered, goes on growing, and the pose agrees with the simulator.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.srv import LoadMap
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.motion import SECOND
from rlml_slam.params import Simulator
from rlml_slam.ros.back_end.searcher import DELAY
from rlml_slam.ros.codecs import decode
from rlml_slam.se2 import Array
from rlml_slam.simulation.robot import RouteFollower
from rlml_slam.simulation.world_file import load_world

SYSTEMS = {1: ('slam',), 2: ('front_end', 'back_end')}
START = 400.0  # [s] for processes to start, and their kernels to be compiled
ROUND = 1.3  # of the route at full speed: the map is saved when the robot has been everywhere
MOST = 30.0  # [s] in which a map has to be entered, besides the delay
ERROR = 0.3  # [m] of a good pose
DEEP = QoSProfile(depth=1000)


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study live-load``."""
    parser = subparsers.add_parser('live-load', help='load a map while driving, over DDS')
    parser.add_argument('--loads', type=int, default=50, help='for each (default: %(default)s)')
    parser.add_argument(
        '--delay', type=float, nargs='+', default=[0.0, 1.0, 5.0], help='of searches [s]'
    )
    parser.add_argument('--processes', type=int, nargs='+', default=[1, 2], choices=[1, 2])
    parser.add_argument('--rate', type=float, default=1.0, help='of the simulator')
    parser.add_argument('--log', type=Path, help='folder of logs (default: kept nowhere)')


def run(args: argparse.Namespace) -> int:
    """One line for each combination; 1 where a load failed."""
    failed = 0
    for processes in args.processes:
        for delay in args.delay:
            good = study(processes, delay, args)
            print(f'{processes} processes, delay {delay:g} s: {good} of {args.loads}', flush=True)
            failed += args.loads - good
    return int(failed > 0)


def study(processes: int, delay: float, args: argparse.Namespace) -> int:
    """How many of the loads were good, with a system of its own."""
    domain = free_domain()
    environment = {
        'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        DELAY: str(delay),
    }  # fmt: skip
    with (
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        own_domain(domain, environment),
        Processes(Path(args.log or maps) / f'log_{processes}_{delay:g}', environment) as children,
    ):
        values = {'map_directory': maps, 'laser_pose': list(Simulator().laser_pose)}
        for name in SYSTEMS[processes]:
            children.start(name, node(name, values))
        drive = {'repeat': 'true', 'rate': args.rate, 'wait_for_subscribers': 1}
        children.start('simulator', node('simulator', drive))
        user = User(children, SYSTEMS[processes])
        try:
            return user.loads(args.loads, MOST + delay)
        finally:
            user.close()


class User(Node):
    """Asks for maps, and compares poses with the truth."""

    def __init__(self, children: Processes, names: tuple[str, ...]) -> None:
        super().__init__('user')
        self._children, self._names = children, (*names, 'simulator')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._true: dict[int, Array] = {}
        self._newest: tuple[int, Array] | None = None
        world, n = load_world(Simulator().world), Simulator()
        self._round = n.still_time + ROUND * RouteFollower(world.route, n).length / n.speed
        self._figures: dict[str, str] = {}
        self._diagnosed = 0
        self.create_subscription(PoseWithCovarianceStamped, 'pose', self.on_pose, DEEP)
        self.create_subscription(Odometry, 'ground_truth', self.on_truth, DEEP)
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, DEEP)

    def on_pose(self, msg: Any) -> None:
        """The newest pose."""
        pose = decode.pose_estimate(msg)
        self._newest = (pose.stamp, pose.pose)

    def on_truth(self, msg: Any) -> None:
        """Where the robot is."""
        pose = decode.planar_pose(msg.pose.pose, 'ground_truth')
        self._true[decode.stamp(msg, 'ground_truth')] = pose

    def on_diagnostics(self, msg: Any) -> None:
        """Figures of the back end."""
        for status in msg.status:
            if status.name.endswith('back_end'):
                self._figures = {v.key: v.value for v in status.values}
                self._diagnosed += 1

    def error(self) -> float:
        """Of the next pose [m], once the truth at its stamp has come as well; NaN if none does."""
        before = self._newest
        self.wait(lambda: self._newest is not before, 5.0)
        if self._newest is None or self._newest is before:
            return float('nan')
        stamp, pose = self._newest
        if not self.wait(lambda: max(self._true, default=0) >= stamp, 5.0):
            return float('nan')
        near = min(self._true, key=lambda t: abs(t - stamp))
        return float(np.hypot(*(pose - self._true[near])[:2]))

    def wait(self, true: Callable[[], bool], seconds: float) -> bool:
        """Whether it became true in time; RlmlError where a process ended."""
        end = time.monotonic() + seconds
        while not true():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.05)
            self._children.check(*self._names)
            if max(self.count_publishers('pose'), self.count_publishers('ground_truth')) > 1:
                raise RlmlError('another system is in this ROS domain: nothing is measured')
        return True

    def ask(self, kind: Any, service: str, request: Any) -> Any:
        """The answer of a service of the back end."""
        client = self.create_client(kind, f'back_end/{service}')
        if not self.wait(client.service_is_ready, START):
            raise RlmlError(f'{service} is not offered')
        future = client.call_async(request)
        if not self.wait(future.done, START):
            raise RlmlError(f'{service} does not answer')
        self.destroy_client(client)
        return future.result()

    def _has_been_everywhere(self) -> bool:
        return (max(self._true) - min(self._true)) / SECOND > self._round

    def loads(self, count: int, most: float) -> int:
        """Drive, save the map, and load it so often; how many were good."""
        if not self.wait(lambda: self._newest is not None, START):
            raise RlmlError('no pose came')
        if not self.wait(self._has_been_everywhere, START):
            raise RlmlError('the robot does not come round')
        saved = self.ask(Trigger, 'save_map', Trigger.Request())
        if not saved.success:
            raise RlmlError(f'save_map: {saved.message}')
        self.wait(lambda: False, 2.0)
        return sum(self.load(k, most) for k in range(count))

    def load(self, k: int, most: float) -> bool:
        """Whether the map was entered, keeps what it had, and grows with the right pose."""
        answer = self.ask(LoadMap, 'load_map', LoadMap.Request(map_url='map'))
        success = answer.result == LoadMap.Response.RESULT_SUCCESS
        since, began = self._diagnosed, time.monotonic()
        self.wait(lambda: self._diagnosed > since, 3.0)
        first = int(self._figures['keyframes'])

        def grows() -> bool:
            entered = 'map not entered' not in self._figures
            return entered and int(self._figures['keyframes']) > first

        entered = self.wait(grows, most)
        took, error = time.monotonic() - began, self.error()
        good = success and entered and error < ERROR
        lag = (self._newest[0] - max(self._true)) * 1e-9 if self._newest else 0.0
        print(f'  load {k}: {took:.1f} s, {error:.3f} m, truth {lag:.2f} s behind', flush=True)
        if not good:
            print(f'load {k}: answered {success}, entered {entered}, error {error:.2f} m, '
                  f'after {took:.1f} s: {self._figures}', flush=True)  # fmt: skip
        return good

    def close(self) -> None:
        """End of the listening."""
        self._executor.shutdown(timeout_sec=1.0)
        self.destroy_node()
