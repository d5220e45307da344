# SPDX-License-Identifier: Apache-2.0
"""``study shadow``: in shadow mode beside another localization, live, then ``rlml compare``.

The other one publishes what AMCL publishes and is wrong by a known circle (amcl.py). Nothing of
ours may come on a name that others use: our nodes may not even be publishers of such a topic.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message

from rlml_lab.dropin import amcl
from rlml_lab.dropin.robot import TRUTH
from rlml_lab.dropin.tf_messages import tf_message
from rlml_slam.cli.main import main
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs.message_types import bag_types, rclpy_class
from rlml_slam.ros.tf import TF_MESSAGE

OURS = ('front_end', 'back_end')
PRIVATE = ('/shadow/', '/front_end/', '/back_end/', '/rosout', '/parameter_events')
LOOK = 1.0  # [s] between two looks at who publishes what
START = 400.0  # [s] for processes to start, and their kernels to be compiled
POSE = '/shadow/pose'
ROOT = str(Path(__file__).resolve().parents[2])
SYSTEM = ('slam', 'robot', 'amcl')


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study shadow``."""
    parser = subparsers.add_parser(
        'shadow', help='in shadow mode beside another localization, live'
    )
    parser.add_argument('--minutes', type=float, default=10.0, help='(default: %(default)s)')


def run(args: argparse.Namespace) -> int:
    """Print what came on shared names, and how far the two were apart; 1 where we were there."""
    tf_message()
    domain = free_domain()
    environment = {
        'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'PYTHONPATH': ROOT,
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix='rlml_map_') as folder:
        bag = Path(folder) / 'bag'
        with (
            own_domain(domain, environment),
            Processes(Path(folder) / 'log', environment) as children,
            BagWriter(bag) as writer,
        ):
            witness = Witness(writer)
            children.start('amcl', ['rlml_lab.dropin.amcl'])
            children.start('slam', node('slam', {'map_directory': folder, 'shadow': 'true'}))
            children.start('robot', ['rlml_lab.dropin.robot'])
            try:
                witness.watch(children, 60.0 * args.minutes)
            finally:
                witness.close()
        print(witness.summary())
        print(f'\nours against /tf, whose AMCL is wrong by a circle of {100 * amcl.OFF:g} cm:')
        main(['compare', str(bag)])
        print('\nours against the truth:')
        main(['compare', str(bag), '--other', f'/{TRUTH}'])
    return int(bool(witness.ours))


class Witness(Node):
    """Hears every topic, and writes those of poses to a bag."""

    def __init__(self, writer: BagWriter) -> None:
        super().__init__('witness')
        self._writer, self._last = writer, 0
        self.heard: Counter[str] = Counter()
        self.map_odom = 0
        self.ours: Counter[str] = Counter()  # looks at which a node of ours had a shared name
        self.looks = 0
        self._seen: dict[str, set[str]] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def watch(self, children: Processes, seconds: float) -> None:
        """Until that long after our first pose; RlmlError if it does not come."""
        self._look()
        end = time.monotonic() + START
        while not self.heard[POSE]:
            self._spin(children)
            if time.monotonic() > end:
                raise RlmlError('the front end never published a pose')
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spin(children)

    def _spin(self, children: Processes) -> None:
        end = time.monotonic() + LOOK
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))
        children.check(*SYSTEM)
        self._look()

    def _look(self) -> None:
        """Subscribe to what is new, and see who publishes."""
        self.looks += 1
        for topic, (kind, *_) in self.get_topic_names_and_types():
            known = self._seen.setdefault(topic, set())
            found = self.get_publishers_info_by_topic(topic)
            known.update(info.node_name for info in found)
            if not topic.startswith(PRIVATE) and any(i.node_name in OURS for i in found):
                self.ours[topic] += 1
            if found and topic not in self.heard:
                self.heard[topic] = 0
                self._subscribe(topic, kind, found[0].qos_profile)

    def _subscribe(self, topic: str, kind: str, offered: QoSProfile) -> None:
        message = rclpy_class(kind)
        if message is None or topic == '/rosout':
            return
        if kind in bag_types().fielddefs:
            is_latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            self._writer.add_topic(topic, kind, latched=is_latched)
        same = QoSProfile(
            depth=1000, durability=offered.durability, reliability=offered.reliability
        )
        take = partial(self._take, topic, kind)
        self.create_subscription(message, topic, take, same, raw=True)

    def _take(self, topic: str, kind: str, data: bytes) -> None:
        self.heard[topic] += 1
        self._last = max(time.time_ns(), self._last + 1)
        if kind in bag_types().fielddefs:
            self._writer.write_serialized(topic, data, self._last)
        if kind == TF_MESSAGE:
            transforms = deserialize_message(data, rclpy_class(kind)).transforms
            self.map_odom += sum(t.header.frame_id == 'map' for t in transforms)

    def summary(self) -> str:
        """Topics with their publishers, and who was where nobody of ours may be."""
        lines = [
            f'{topic}: {n} messages of {", ".join(sorted(self._seen[topic])) or "nobody"}'
            for topic, n in sorted(self.heard.items())
        ]
        others = sum(self.heard[f'/{topic}'] for topic in amcl.TOPICS)
        lines += [
            '',
            f'map to odom on /tf: {self.map_odom}, amcl_pose: {self.heard["/amcl_pose"]}',
            f"of AMCL's on its names: {others}",
            f'{self.looks} looks; shared names with a publisher of ours: {dict(self.ours) or 0}',
        ]
        return '\n'.join(lines)

    def close(self) -> None:
        """End of the listening."""
        self._executor.shutdown(timeout_sec=1.0)
        self.destroy_node()
