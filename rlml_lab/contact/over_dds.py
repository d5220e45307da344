# SPDX-License-Identifier: Apache-2.0
"""Mutated messages and random bytes to a running ``slam``, beside those of a simulator."""

from __future__ import annotations

import math
import tempfile
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from rlml_lab.contact.good_messages import stream_of_room
from rlml_lab.contact.mutation import beside, random_bytes
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.cli.support.usage import Usage
from rlml_slam.errors import RlmlError
from rlml_slam.params import Simulator
from rlml_slam.ros.codecs import decode
from rlml_slam.se2 import Array, align, transform

START = 400.0  # [s] for processes to start, and their kernels to be compiled
QOS = QoSProfile(depth=1000)
# shallow: where it is slow, the newest are wanted, and its own ones while they are remembered
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
BYTES = 0.05  # share of random bytes
TOPICS = ('scan', 'odom', 'imu', 'reflectors')
FILLED = 10.0  # [s] until the black box is full
MOST = 20  # messages that are received for each one sent: more than all topics have between two
SAMPLED = 1.0  # [s] between two looks at the memory
OWN = 2000  # messages that are remembered as the intruder's own


class Intruder(Node):
    """Publishes mutated messages between those of the simulator, on the same topics.

    What the simulator sends goes its own way: an intruder that is slow must not delay it.
    """

    def __init__(self, seed: int) -> None:
        super().__init__('intruder')
        self._rng = np.random.default_rng(seed)
        good = dict(stream_of_room(3.0))
        self._kinds = {topic: type(good[topic]) for topic in TOPICS}
        self._good = {topic: serialize_message(good[topic]) for topic in TOPICS}  # the newest
        self._own: deque[bytes] = deque(maxlen=OWN)
        self.true: dict[int, Array] = {}
        self.poses: dict[int, Array] = {}
        self.refused: dict[str, str] = {}
        self.sent = self.heard = 0
        self.rate = 0.0  # [Hz] at which they were sent
        self.growth = math.nan  # [MB] of the node's memory
        self._out = {
            topic: self.create_publisher(kind, topic, QOS) for topic, kind in self._kinds.items()
        }
        for topic, kind in self._kinds.items():
            use = partial(self.on_sensor, topic)
            self.create_subscription(kind, topic, use, SENSOR, raw=True)
        self.create_subscription(PoseWithCovarianceStamped, 'pose', self.on_pose, QOS)
        self.create_subscription(Odometry, 'ground_truth', self.on_truth, QOS)
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, QOS)

    def on_sensor(self, topic: str, data: bytes) -> None:
        """A message of a sensor: a good one is what the next mutated ones are made of."""
        self.heard += 1
        if data not in self._own:
            self._good[topic] = data

    def on_pose(self, msg: Any) -> None:
        """A pose of the front end."""
        self.heard += 1
        pose = decode.pose_estimate(msg)
        self.poses[pose.stamp] = pose.pose

    def on_truth(self, msg: Any) -> None:
        """Where the robot is."""
        self.heard += 1
        stamp = decode.stamp(msg, 'ground_truth')
        self.true[stamp] = decode.planar_pose(msg.pose.pose, 'ground_truth')

    def on_diagnostics(self, msg: Any) -> None:
        """What was refused."""
        self.heard += 1
        for status in msg.status:
            if status.name.endswith('front_end'):
                self.refused = {v.key: v.value for v in status.values}

    def send(self) -> None:
        """One message that nobody should send."""
        topic = str(self._rng.choice(TOPICS))
        if self._rng.random() < BYTES:
            data = random_bytes(self._rng)
        else:
            msg = beside(self._good[topic], self._kinds[topic], topic, self._rng)
            data = serialize_message(msg)
        self._own.append(data)
        self._out[topic].publish(data)
        self.sent += 1


def drive(messages: int, rate: float, seed: int, log: Path, seconds: float) -> Intruder:
    """Drive for a while [s] with ``messages`` intruding at a rate [Hz]; RlmlError if one ends."""
    domain = free_domain()
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with (
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        own_domain(domain, environment),
        Processes(log, environment) as children,
    ):
        values = {
            'map_directory': maps, 'laser_pose': list(Simulator().laser_pose),
            'incident.before': FILLED, 'incident.min_period': 1e4,
        }  # fmt: skip
        children.start('slam', node('slam', values))
        words = node('simulator', {'repeat': 'true', 'wait_for_subscribers': 2})
        children.start('simulator', words)
        intruder = Intruder(seed)
        executor = SingleThreadedExecutor()
        executor.add_node(intruder)
        try:
            _run(intruder, executor, children, messages, rate, seconds)
            children.check('slam', 'simulator')
        finally:
            executor.shutdown(timeout_sec=1.0)
            intruder.destroy_node()
    return intruder


def _run(
    intruder: Intruder, executor: Any, children: Processes, messages: int, rate: float,
    seconds: float,
) -> None:  # fmt: skip
    end = time.monotonic() + START
    while not intruder.poses:
        if time.monotonic() > end:
            raise RlmlError('no pose came')
        executor.spin_once(timeout_sec=0.1)
        children.check('slam', 'simulator')
    began, memory = time.monotonic(), list[Usage]()
    while intruder.sent < messages or time.monotonic() - began < seconds:
        _receive(intruder, executor, 0.5 / rate)
        # one at a time: where the machine is too slow for the rate, poses come all the same
        if intruder.sent < min(messages, rate * (time.monotonic() - began)):
            intruder.send()
            intruder.rate = intruder.sent / (time.monotonic() - began)
        children.check('slam', 'simulator')
        if not memory or time.monotonic() - memory[-1].time > SAMPLED:
            used = children.usage('slam')
            memory += [] if used is None else [used]
    half = [u.rss_mb for u in memory if u.time - began > 0.5 * (time.monotonic() - began)]
    intruder.growth = half[-1] - half[0] if half else math.nan


def _receive(intruder: Intruder, executor: Any, timeout: float) -> None:
    """Take what has arrived, MOST messages at once; wait [s] for the first of them."""
    for _ in range(MOST):
        before = intruder.heard
        executor.spin_once(timeout_sec=timeout)
        if intruder.heard == before:
            return
        timeout = 0.0


def figures(of: Intruder) -> tuple[float, float]:
    """Poses of the simulator's scans per second, and their root mean square error [m].

    From the first pose until the end of the drive: a node that falls silent is seen. The map
    begins somewhere: the error is what is left where the two ways fit best.
    """
    stamps = sorted(of.poses.keys() & of.true.keys())
    if len(stamps) < 2:
        return 0.0, math.nan
    poses = np.array([of.poses[t][:2] for t in stamps])
    true = np.array([of.true[t][:2] for t in stamps])
    away = transform(align(poses, true), poses) - true
    rate = (len(stamps) - 1) / ((max(of.true) - stamps[0]) * 1e-9)
    return rate, float(np.sqrt(np.mean(np.sum(away**2, axis=-1))))
