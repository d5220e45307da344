# SPDX-License-Identifier: Apache-2.0
"""Nodes in this process and as processes, apart from everything else on the machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from rlml_slam.cli.support.processes import free_domain
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs.message_types import rclpy_class

ROOT = Path(__file__).resolve().parents[2]
ROOM = ROOT / 'bags' / 'room'
DOMAIN = free_domain()  # two systems in one domain hear each other
BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STREAM_OF = {'/scan': 'scan', '/odom': 'odom', '/imu': 'imu', '/reflectors': 'reflectors'}


def overrides(**values):
    """Parameter overrides as a YAML file or the command line gives them."""
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]


class LiveNodes:
    """A ROS context of its own with nodes, one of which listens."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes = []
        self.heard = defaultdict(list)
        self.ear = self.add(Node('ear', context=self.context))

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def start(self, kind, **values):
        return self.add(kind(context=self.context, parameter_overrides=overrides(**values)))

    def listen(self, topic, msgtype, qos=BEST_EFFORT):
        self.ear.create_subscription(rclpy_class(msgtype), topic, self.heard[topic].append, qos)

    def spin_until(self, true, timeout=20.0, what=''):
        end = time.monotonic() + timeout
        while not true():
            counts = {topic: len(m) for topic, m in self.heard.items()}
            assert time.monotonic() < end, f'{what or "waited in vain"}; heard {counts}'
            self.executor.spin_once(timeout_sec=0.05)

    def drain(self, rounds=10):
        """Spin until nothing has been heard for some rounds."""
        quiet = 0
        while quiet < rounds:
            before = self.count()
            self.executor.spin_once(timeout_sec=0.02)
            quiet = quiet + 1 if self.count() == before else 0

    def count(self):
        """Messages heard so far."""
        return sum(len(m) for m in self.heard.values())

    def call(self, kind, name, request, timeout=20.0):
        client = self.ear.create_client(kind, name)
        self.spin_until(client.service_is_ready, timeout, f'{name} is not offered')
        future = client.call_async(request)
        self.spin_until(future.done, timeout, f'{name} does not answer')
        self.ear.destroy_client(client)
        return future.result()

    def close(self):
        for node in self.nodes:
            node.destroy_node()
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)


def room(topics=tuple(STREAM_OF), seconds=30.0):
    """(stream or topic, message) of the sample bag for a while, as rclpy delivers them."""
    with BagReader(ROOM) as bag:
        kinds = {t.name: rclpy_class(t.msgtype) for t in bag.topics.values()}
        for stamp, topic, data in bag.serialized(topics):
            if stamp > bag.start + seconds * 1e9:
                return
            yield STREAM_OF.get(topic, topic), deserialize_message(data, kinds[topic])


class Process:
    """An executable of the package as a process of its own, in the folder ``cwd``."""

    def __init__(self, name, *args, cwd=None):
        env = {k: v for k, v in os.environ.items() if k != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
        env |= {'ROS_DOMAIN_ID': str(DOMAIN), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        env['PYTHONPATH'] = os.pathsep.join([str(ROOT), env.get('PYTHONPATH', '')])
        self._process = subprocess.Popen(
            [sys.executable, '-m', name if '.' in name else f'rlml_slam.nodes.{name}', *args],
            cwd=cwd, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def interrupt(self, number=signal.SIGINT):
        self._process.send_signal(number)

    def finish(self, timeout=30.0):
        """Exit code and all that was printed."""
        try:
            out, _ = self._process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            out, _ = self._process.communicate()
            raise AssertionError(f'did not end: {out}') from None
        return self._process.returncode, out

    def close(self):
        """End it, whatever happened before; what it printed is shown where a test fails."""
        self._process.kill()
        if not self._process.stdout.closed:
            print(f'process {self._process.args[2]}:', self._process.communicate()[0])
