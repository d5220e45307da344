# SPDX-License-Identifier: Apache-2.0
"""``study starved``: mutated messages beside a node that has no processor for seconds at a time.

While it sleeps, only the newest messages of each topic are kept, as a subscription keeps them. So
most messages are lost, wrong ones come at the end of gaps, and many come at once.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.serialization import deserialize_message, serialize_message

from rlml_lab.contact.good_messages import STREAMS
from rlml_lab.contact.in_process import PLACE, SENSORS, Truth
from rlml_lab.contact.mutation import beside
from rlml_slam.cli.main import main as command
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.nodes.slam import connected
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.se2 import align, transform
from rlml_slam.slam.conversation import SessionFrame

DEPTH = {'scan': 5, 'odom': 20, 'imu': 20, 'reflectors': 5}  # messages that wait
AWAKE, SLEEPS = 50_000_000, 0.2  # [ns] between looks at what waits; share of these that is a sleep
SETTLE = 200  # messages after which the back end has caught up


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study starved``."""
    parser = subparsers.add_parser(
        'starved', help='mutated messages beside a node that often has no processor'
    )
    parser.add_argument('--world', default='hall')
    parser.add_argument('--duration', type=float, default=120.0, help='of the drive [s]')
    parser.add_argument('--rate', type=float, default=300.0, help='of mutated messages [Hz]')
    parser.add_argument('--asleep', type=float, default=1.0, help='mean length of a sleep [s]')
    parser.add_argument('--seeds', type=int, default=3)


def run(args: argparse.Namespace) -> int:
    """One line for each seed."""
    print('seed  scans used  rms [m]  largest [m]  OK and off by .5 m')
    for seed in range(args.seeds):
        with tempfile.TemporaryDirectory(prefix='rlml_starved_') as folder:
            bag, before = Path(folder) / 'bag', Path.cwd()
            words = ['simulate', args.world, str(bag), '--seed', str(seed), '--json']
            with contextlib.redirect_stdout(io.StringIO()):
                command([*words, '--duration', str(args.duration)])
            os.chdir(folder)  # maps are saved there
            try:
                share, errors, ok = drive(bag, args.rate, args.asleep, seed)
            finally:
                os.chdir(before)
        rms, wrong = float(np.sqrt(np.mean(errors**2))), float(np.mean(ok & (errors > 0.5)))
        figures = f'{100 * share:10.0f} % {rms:8.3f} {errors.max():12.3f} {100 * wrong:16.1f} %'
        print(f'{seed:4d} {figures}')
    return 0


def drive(
    bag: Path, rate: float, asleep: float, seed: int
) -> tuple[float, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Share of the scans that have a pose; errors [m] where the paths fit best; is health OK."""
    rng, stream, true = np.random.default_rng(seed), *_read(bag)
    context = Context()
    rclpy.init(context=context)
    front = FrontEndNode(has_back_end=True, context=context, parameter_overrides=PLACE)
    back = connected(front, context=context)
    front.sensors.stop_waiting()
    take, poses = front.take, dict[int, tuple[Any, bool]]()

    def note(record: SessionFrame) -> None:
        frame = record.frame
        poses[frame.stamp] = frame.T_map_base, frame.health.level == 0
        if take is not None:
            take(record)

    front.take = note
    waiting = {kind: deque[tuple[int, Any]](maxlen=DEPTH[kind]) for kind in SENSORS}
    good: dict[str, Any] = {}
    due, last, wakes, number = 0.0, stream[0][0], 0, 0
    try:
        for stamp, kind, msg in stream:
            if stamp >= wakes:
                _give(waiting, front)
                sleeps = asleep > 0.0 and rng.random() < SLEEPS
                wakes = stamp + (int(rng.exponential(asleep) * 1e9) if sleeps else AWAKE)
            due, last = due + rate * (stamp - last) * 1e-9, stamp
            while due >= 1.0 and len(good) == len(SENSORS):
                due, number, name = due - 1.0, number + 1, str(rng.choice(SENSORS))
                waiting[name].append(
                    (number, beside(serialize_message(good[name]), type(good[name]), name, rng))
                )
            number += 1
            waiting[kind].append((number, msg))
            good[kind] = msg
            if number % SETTLE == 0:
                back.mapper.worker.submit(lambda: None).result()
        back.mapper.worker.submit(lambda: None).result()
    finally:
        for node in (front, back):
            node.destroy_node()
        rclpy.shutdown(context=context)
    common = sorted(poses.keys() & true.keys())
    there = np.array([poses[t][0][:2] for t in common])
    want = np.array([true[t][:2] for t in common])
    errors = np.linalg.norm(transform(align(there, want), there) - want, axis=-1)
    scans = sum(kind == 'scan' for _, kind, _ in stream)
    return len(common) / scans, errors, np.array([poses[t][1] for t in common])


def _give(waiting: dict[str, deque[tuple[int, Any]]], front: FrontEndNode) -> None:
    """All that waits, in the order in which it came."""
    for _, name, msg in sorted(
        ((number, name, msg) for name, kept in waiting.items() for number, msg in kept),
        key=lambda each: each[0],
    ):
        front.sensors.add(name, msg)
    for kept in waiting.values():
        kept.clear()


def _read(bag: Path) -> tuple[list[tuple[int, str, Any]], Truth]:
    """(Stamp of arrival, stream, message) of a simulated bag, and the true poses."""
    with BagReader(bag) as reader:
        kinds = {t.name: rclpy_class(t.msgtype) for t in reader.topics.values()}
        stream = [
            (stamp, STREAMS[topic], deserialize_message(data, kinds[topic]))
            for stamp, topic, data in reader.serialized(tuple(STREAMS))
        ]
        truth = [
            deserialize_message(data, kinds['/ground_truth'])
            for _, _, data in reader.serialized(('/ground_truth',))
        ]
    at = {decode.stamp(m, 'ground_truth'): m.pose.pose for m in truth}
    return stream, {t: decode.planar_pose(pose, 'ground_truth') for t, pose in at.items()}
