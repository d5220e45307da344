# SPDX-License-Identifier: Apache-2.0
"""``study lifecycle``: a client makes transitions at random instants while a robot drives.

Every answer is compared with the states of a managed node as ROS 2 defines them. While a node is
inactive or less, it may publish nothing that others use; once both are active, poses come again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.params import Simulator

NODES = ('front_end', 'back_end')
UNCONFIGURED, INACTIVE, ACTIVE = 1, 2, 3  # as lifecycle_msgs/State has them
GOAL = {
    (UNCONFIGURED, Transition.TRANSITION_CONFIGURE): INACTIVE,
    (INACTIVE, Transition.TRANSITION_ACTIVATE): ACTIVE,
    (ACTIVE, Transition.TRANSITION_DEACTIVATE): INACTIVE,
    (INACTIVE, Transition.TRANSITION_CLEANUP): UNCONFIGURED,
}
NAMES = {
    Transition.TRANSITION_CONFIGURE: 'configure', Transition.TRANSITION_ACTIVATE: 'activate',
    Transition.TRANSITION_DEACTIVATE: 'deactivate', Transition.TRANSITION_CLEANUP: 'cleanup',
}  # fmt: skip
START = 400.0  # [s] for processes to start, and their kernels to be compiled
ANSWER = 30.0  # [s] for a transition, which may have to save a map
UNFIT = 0.2  # of the transitions are such as the state does not have


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study lifecycle``."""
    parser = subparsers.add_parser('lifecycle', help='transitions at random instants, over DDS')
    parser.add_argument('--walks', type=int, default=100, help='(default: %(default)s)')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--longest', type=float, default=1.0, help='between transitions [s]')


def run(args: argparse.Namespace) -> int:
    """Print what was found; 1 where anything was wrong."""
    domain = free_domain()
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with (
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        own_domain(domain, environment),
        Processes(Path(maps) / 'log', environment) as children,
    ):
        values = {
            'map_directory': maps, 'laser_pose': list(Simulator().laser_pose),
            'autostart': 'false',
        }  # fmt: skip
        children.start('slam', node('slam', values))
        children.start('simulator', node('simulator', {'repeat': 'true'}))
        manager = Manager(children, np.random.default_rng(args.seed), args.longest)
        try:
            for k in range(args.walks):
                manager.walk()
                usage = children.usage('slam')
                memory = f', {usage.rss_mb:.0f} MB' if usage is not None else ''
                print(f'  walk {k}: {manager.summary()}{memory}', flush=True)
        finally:
            manager.close()
        print(manager.summary())
        print('\n'.join(manager.wrong))
        return int(bool(manager.wrong))


class Manager(Node):
    """Makes transitions, and listens whether the nodes do as they answer."""

    def __init__(self, children: Processes, rng: np.random.Generator, longest: float) -> None:
        super().__init__('manager')
        self._children, self._rng, self._longest = children, rng, longest
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._state = dict.fromkeys(NODES, UNCONFIGURED)
        self._heard: Counter[str] = Counter()
        self.made: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.waits: list[float] = []  # [s] from both active to the first pose
        self._change = {n: self.create_client(ChangeState, f'{n}/change_state') for n in NODES}
        self._get = {n: self.create_client(GetState, f'{n}/get_state') for n in NODES}
        for kind, topic, name in (
            (PoseWithCovarianceStamped, 'pose', 'front_end'),
            (Odometry, 'front_end/odometry', 'front_end'),
            (DiagnosticStatus, 'front_end/health', 'front_end'),
            (DiagnosticStatus, 'back_end/health', 'back_end'),
            (PoseWithCovarianceStamped, 'correction', 'back_end'),
        ):
            self.create_subscription(kind, topic, self._counts(name), 100)

    def _counts(self, name: str) -> Callable[[Any], None]:
        return lambda _: self._heard.update((name,))

    def walk(self) -> None:
        """Transitions of both nodes at random, then to active, then back to unconfigured."""
        for _ in range(int(self._rng.integers(2, 8))):
            self._step(str(self._rng.choice(NODES)))
        for name in NODES:
            while self._state[name] != ACTIVE:
                self._make(name, self._next(name, up=True))
        self._expect_poses()
        for name in NODES:
            while self._state[name] != UNCONFIGURED:
                self._make(name, self._next(name, up=False))

    def _next(self, name: str, up: bool) -> int:
        fit = {t: goal for (s, t), goal in GOAL.items() if s == self._state[name]}
        order = (UNCONFIGURED, INACTIVE, ACTIVE)
        at = order.index(self._state[name])
        return next(t for t, goal in fit.items() if (order.index(goal) > at) == up)

    def _step(self, name: str) -> None:
        fit = [t for (s, t) in GOAL if s == self._state[name]]
        unfit = [t for t in NAMES if t not in fit]
        choice = unfit if self._rng.random() < UNFIT else fit
        self._make(name, int(self._rng.choice(choice)))

    def _make(self, name: str, transition: int) -> None:
        """One transition, its answer, the state after it, and what is published in it."""
        self._spin(float(self._rng.uniform(0.0, self._longest)))
        goal = GOAL.get((self._state[name], transition))
        what = f'{name}: {NAMES[transition]} of state {self._state[name]}'
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._ask(self._change[name], request, what)
        self._state[name] = self._state[name] if goal is None else goal
        state = self._ask(self._get[name], GetState.Request(), what).current_state.id
        if answer.success != (goal is not None) or state != self._state[name]:
            self.wrong.append(f'{what}: answered {answer.success}, is now {state}')
        self.made[NAMES[transition] if goal is not None else 'refused'] += 1
        if self._state[name] != ACTIVE:
            self._spin(0.1)  # what was on its way
            self._heard[name] = 0
            self._spin(0.3)
            if self._heard[name]:
                self.wrong.append(f'{what}: {self._heard[name]} messages while it is not active')

    def _expect_poses(self) -> None:
        self._heard['front_end'], began = 0, time.monotonic()
        while self._heard['front_end'] < 10:
            self._spin(0.02)
            if time.monotonic() - began > ANSWER:
                self.wrong.append('no pose although both are active')
                return
        self.waits.append(time.monotonic() - began)

    def _ask(self, client: Any, request: Any, what: str) -> Any:
        limit = START if not self.made else ANSWER
        if not client.wait_for_service(timeout_sec=limit):
            raise RlmlError(f'{what}: the service is not offered')
        future, end = client.call_async(request), time.monotonic() + limit
        while not future.done():
            self._spin(0.01)
            if time.monotonic() > end:
                raise RlmlError(f'{what}: no answer within {limit:.0f} s')
        return future.result()

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))
        self._children.check('slam', 'simulator')

    def summary(self) -> str:
        """Transitions so far, and what went wrong."""
        made = ', '.join(f'{name} {n}' for name, n in sorted(self.made.items()))
        slow = f'{np.median(self.waits):.2f}, at most {max(self.waits):.2f}' if self.waits else '—'
        return f'{made}; 10 messages after {slow} s; wrong {len(self.wrong)}'

    def close(self) -> None:
        """End of the listening."""
        self._executor.shutdown(timeout_sec=1.0)
        self.destroy_node()
