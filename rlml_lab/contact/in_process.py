# SPDX-License-Identifier: Apache-2.0
"""Mutated messages through the callbacks of nodes in this process, beside a good stream."""

from __future__ import annotations

import resource
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from rlml_lab.contact.good_messages import ROOM, private_messages, stream_of_room
from rlml_lab.contact.mutation import damaged_bytes, mutated, random_bytes
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.nodes.slam import connected
from rlml_slam.params import Simulator
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import SessionFrame

PLACE = [Parameter('laser_pose', value=list(Simulator().laser_pose))]
HANG = 1.0  # [s] that no message may take
Truth = dict[int, Array]  # pose (3,) in the map by stamp
SENSORS = ('scan', 'odom', 'imu', 'reflectors')


@dataclass
class Contact:
    """What became of the messages of a run."""

    sent: int = 0
    escaped: list[str] = field(default_factory=list)
    slowest: float = 0.0  # [s]
    slowest_of: str = ''
    refused: Counter[str] = field(default_factory=Counter)  # by topic
    unexpected: Counter[str] = field(default_factory=Counter)  # caught, but bugs; by error
    poses: dict[int, Array] = field(default_factory=dict)

    def give(self, what: str, callback: Any, msg: Any) -> None:
        """Give one message to a callback."""
        began = time.perf_counter()
        try:
            callback(msg)
        except Exception as e:
            self.escaped.append(f'{what}: {type(e).__name__}: {e}')
        took = time.perf_counter() - began
        self.sent += 1
        if took > self.slowest:
            self.slowest, self.slowest_of = took, what

    def add_refused(self, *nodes: Any) -> None:
        """Count what the nodes refused, and errors that their guards caught but did not expect."""
        for node in nodes:
            self.refused.update(guard_of(node).refused)
            self.unexpected.update(guard_of(node).unexpected)
            sensors = getattr(node, 'sensors', None)
            totals = sensors.synchronizer.inputs.totals() if sensors is not None else {}
            for stream, counts in totals.items():
                self.refused[stream] += sum(n for what, n in counts.items() if what != 'used')

    def problems(self) -> list[str]:
        """Bounds that were not kept."""
        bugs = [f'{n} times {text}' for text, n in self.unexpected.most_common(20)]
        hangs = [f'{self.slowest_of} took {self.slowest:.2f} s'] if self.slowest > HANG else []
        return [*sorted(set(self.escaped))[:10], *bugs, *hangs]

    def lines(self, name: str) -> list[str]:
        """The figures, in words."""
        refused = sum(self.refused.values())
        worst = f'slowest {1e3 * self.slowest:.1f} ms ({self.slowest_of})'
        return [
            f'{name}: {self.sent} messages, {len(self.escaped)} exceptions escaped, '
            f'{self.unexpected.total()} caught that are bugs, {refused} refused, {worst}',
            *(f'  escaped: {text[:200]}' for text in sorted(set(self.escaped))[:10]),
        ]


def memory() -> float:
    """Largest resident size so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def callbacks_of(node: Any) -> dict[str, Any]:
    """What takes the bytes of every subscription of a node, by topic without its namespace."""
    return {s.topic_name.lstrip('/'): s.callback for s in node.subscriptions}


def sensors(share: float, seed: int) -> Contact:
    """The sample bag through front end and back end, with ``share`` mutated messages for each."""
    rng, contact, stream = np.random.default_rng(seed), Contact(), stream_of_room()
    context = Context()
    rclpy.init(context=context)
    front = FrontEndNode(has_back_end=True, context=context, parameter_overrides=PLACE)
    back = connected(front, context=context)
    front.sensors.stop_waiting()
    take = front.take

    def note(record: SessionFrame) -> None:
        contact.poses[record.frame.stamp] = record.frame.T_map_base
        if take is not None:
            take(record)

    front.take = note
    templates: dict[str, Any] = {}
    due = 0.0
    try:
        for name, msg in stream:
            front.sensors.add(name, msg)
            templates[name] = msg
            due += share
            while due >= 1.0 and len(templates) == len(SENSORS):
                due -= 1.0
                kind = str(rng.choice(SENSORS))
                bad = mutated(templates[kind], rng)
                contact.give(kind, lambda m, k=kind: front.sensors.add(k, m), bad)
        back.mapper.worker.submit(lambda: None).result()
        contact.add_refused(front, back)
    finally:
        for node in (front, back):
            node.destroy_node()
        rclpy.shutdown(context=context)
    return contact


def topics(mutations: int, seed: int) -> Contact:
    """Every topic of a front end and of a back end, sensors included, by their callbacks."""
    rng, contact, stream = np.random.default_rng(seed), Contact(), stream_of_room(6.0)
    context = Context()
    rclpy.init(context=context)
    front = FrontEndNode(context=context, parameter_overrides=PLACE)
    back = BackEndNode(context=context)
    front.sensors.stop_waiting()
    records: list[SessionFrame] = []
    front.take = records.append
    try:
        for name, msg in stream:
            front.sensors.add(name, msg)
        whole = next(
            r for r in reversed(records)
            if r.frame.observation.points is not None
            and r.frame.observation.detections is not None
        )  # fmt: skip
        good = {**{k: [m] for k, m in dict(stream).items()}, **private_messages(whole)}
        listens = [
            (topic, callback, good[topic])
            for node in (front, back)
            for topic, callback in callbacks_of(node).items()
            if topic in good
        ]
        for _ in range(mutations):
            topic, callback, samples = listens[int(rng.integers(len(listens)))]
            bad: Any = samples[int(rng.integers(len(samples)))]
            way = rng.random()
            if way < 0.02:
                data = random_bytes(rng)
            elif way < 0.1:
                data = damaged_bytes(serialize_message(bad), rng)
            else:
                data = serialize_message(mutated(bad, rng))
            contact.give(topic, callback, data)
            if contact.sent % 1000 == 0:
                back.mapper.worker.submit(lambda: None).result()
                back.mapper.worker.check()
        contact.add_refused(front, back)
    finally:
        for node in (front, back):
            node.destroy_node()
        rclpy.shutdown(context=context)
    return contact


def truth_of_room() -> Truth:
    """True poses of the sample bag in its map frame, by stamp."""
    with BagReader(ROOM) as bag:
        kind = rclpy_class('nav_msgs/msg/Odometry')
        found = [deserialize_message(d, kind) for _, _, d in bag.serialized(('/ground_truth',))]
    return {
        decode.stamp(m, 'ground_truth'): decode.planar_pose(m.pose.pose, 'ground_truth')
        for m in found
    }


def compared(
    clean: Contact, dirty: Contact, truth: dict[int, Array]
) -> tuple[float, float, float]:
    """Share of the clean poses that came as well, and both median errors [m]."""
    common = clean.poses.keys() & dirty.poses.keys()

    def error(of: Contact) -> float:
        steps = [np.hypot(*(of.poses[t] - truth[t])[:2]) for t in common if t in truth]
        return float(np.sqrt(np.mean(np.square(steps)))) if steps else float('nan')

    return len(common) / max(len(clean.poses), 1), error(clean), error(dirty)
