# SPDX-License-Identifier: Apache-2.0
"""``study tf-now``: tf2's own buffer, live, is asked where the robot is now, every 20 ms.

Odometry comes at 50 Hz with the stamps of its transforms: nobody knows odom to base_link later
than the newest of them. So "now" is asked as nav2 asks, with a timeout; and map to odom alone,
which is what this package publishes, without any.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from rlml_lab.dropin.buffer_core import INSTALL, BufferCore, is_installed
from rlml_lab.dropin.tf_messages import tf_message
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.ros.codecs import decode
from rlml_slam.simulation.robot import SECOND

PERIOD = 0.02  # [s] between questions
TIMEOUT = 0.1  # [s] a question for map to base waits, as nav2's controllers do by default
START = 400.0  # [s] for processes to start, and their kernels to be compiled
ROOT = str(Path(__file__).resolve().parents[2])
MAP_ODOM, MAP_BASE, ODOM_BASE = ('map', 'odom'), ('map', 'base_link'), ('odom', 'base_link')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study tf-now``."""
    parser = subparsers.add_parser('tf-now', help="tf2's own buffer asks where the robot is now")
    parser.add_argument('--minutes', type=float, default=5.0, help='(default: %(default)s)')
    parser.add_argument('--tolerance', type=float, help='transform_tolerance [s]')


def run(args: argparse.Namespace) -> int:
    """Print how often tf2 refused, of which question; 1 where it ever did."""
    tf_message()
    if not is_installed():
        raise RlmlError(f"the system's Python has no tf2: {INSTALL}")
    domain = free_domain()
    environment = {
        'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'PYTHONPATH': ROOT,
    }  # fmt: skip
    values = {} if args.tolerance is None else {'transform_tolerance': args.tolerance}
    with (
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        own_domain(domain, environment),
        Processes(Path(maps) / 'log', environment) as children,
        BufferCore() as core,
    ):
        children.start('slam', node('slam', {'map_directory': maps, **values}))
        children.start('robot', ['rlml_lab.dropin.robot'])
        listener = Listener(core)
        try:
            listener.listen(children, 60.0 * args.minutes)
        finally:
            listener.close()
    print(listener.summary())
    return int(listener.refused.total() > 0)


class Listener(Node):
    """Gives what comes on /tf to the buffer, and asks it."""

    def __init__(self, core: BufferCore) -> None:
        super().__init__('listener')
        self._core, self._asks, self._newest = core, False, 0
        self._waiting: list[int] = []
        self.asked: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.why: dict[str, str] = {}  # of the last refusal
        self.heard: Counter[tuple[str, str]] = Counter()
        self.waits: list[float] = []  # [ms]
        self.ahead: list[float] = []  # [ms] of the newest map to odom, when it is asked for
        self._dated = 0
        kind = tf_message()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(kind, '/tf', self._on_tf, QoSProfile(depth=100))
        self.create_subscription(kind, '/tf_static', self._on_tf, latched)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD, self._ask, clock=steady)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def listen(self, children: Processes, seconds: float) -> None:
        """From the first map to odom on; RlmlError if a process dies or it does not come."""
        end = time.monotonic() + START
        while not self._asks:
            self._spin(children, 0.1)
            if time.monotonic() > end:
                raise RlmlError('map to odom does not come')
            if self.heard[MAP_ODOM] > 1:
                self._spin(children, 1.0)
                self._asks = True
        for k in range(max(1, round(seconds / 10.0))):
            self._spin(children, min(seconds, 10.0))
            if k % 6 == 5:
                print(f'  {10 * (k + 1)} s: {self.refused.total()} refused', flush=True)

    def _spin(self, children: Processes, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))
        children.check('slam', 'robot')

    def _on_tf(self, msg: Any) -> None:
        for t in msg.transforms:
            stamp, edge = decode.stamp(t, '/tf'), (t.header.frame_id, t.child_frame_id)
            p, q = t.transform.translation, t.transform.rotation
            self._core.add(stamp, edge, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
            self.heard[edge] += 1
            if edge == MAP_ODOM:
                self._dated = max(self._dated, stamp)
            elif edge == ODOM_BASE:
                self._newest = max(self._newest, stamp)
        self._answer()

    def _ask(self) -> None:
        if not self._asks:
            return
        now = time.time_ns()
        self.ahead.append((self._dated - now) / 1e6)
        self._count('map to odom now, at once', self._core.ask(now, MAP_ODOM))
        self._count(
            'map to base at the newest odometry, at once', self._core.ask(self._newest, MAP_BASE)
        )
        self._waiting.append(now)
        self._answer()

    def _answer(self) -> None:
        """Questions that wait: answered, or too old."""
        now, still = time.time_ns(), []
        for asked in self._waiting:
            found = self._core.ask(asked, MAP_BASE)
            if found is None and now - asked <= TIMEOUT * SECOND:
                still.append(asked)
                continue
            self.waits.append((now - asked) / 1e6)
            self._count(f'map to base now, within {TIMEOUT:g} s', found)
        self._waiting = still

    def _count(self, question: str, found: Any) -> None:
        self.asked[question] += 1
        if found is None:
            self.refused[question] += 1
            self.why[question] = self._core.why

    def summary(self) -> str:
        """What was asked and refused, how long it waited, and how far map to odom is ahead."""
        lines = [f'{q}: {self.refused[q]} of {n} refused' for q, n in self.asked.items()]
        lines += [f'  the last: {why}' for why in self.why.values()]
        wait, ahead = (
            np.percentile(self.waits, [50, 99, 100]),
            np.percentile(self.ahead, [0, 1, 50]),
        )
        lines += [
            'waited for odometry: median {:.0f}, 99 % {:.0f}, at most {:.0f} ms'.format(*wait),
            'map to odom ahead of now: at least {:.0f}, 1 % {:.0f}, median {:.0f} ms'.format(
                *ahead
            ),
            'heard: ' + ', '.join(f'{a} to {b} {n}' for (a, b), n in sorted(self.heard.items())),
        ]
        return '\n'.join(lines)

    def close(self) -> None:
        """End of the listening."""
        self._executor.shutdown(timeout_sec=1.0)
        self.destroy_node()
