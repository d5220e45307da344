# SPDX-License-Identifier: Apache-2.0
"""What `rlml view` makes of messages, given to it by hand, and how little it does for that."""

from __future__ import annotations

import logging
import time
from collections import defaultdict, deque
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from rlml_slam.cli.view import listener as view
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.frame_messages import build_points, build_record
from rlml_slam.ros.codecs.message_types import make_rclpy
from rlml_slam.ros.codecs.reflector_clouds import build_associated
from rlml_slam.slam.conversation import SessionFrame
from rlml_slam.types import Detections, Frame, Health, Level, Motion, Observation

SECOND = 1_000_000_000


class Queues:
    """Stands for a node; each topic has a queue of serialized messages."""

    def __init__(self):
        self.waiting = defaultdict(deque)

    def create_subscription(self, kind, topic, callback, qos, raw):
        handle = nullcontext()
        handle.take_message = lambda *_: (
            (self.waiting[topic].popleft(), None) if self.waiting[topic] else None
        )
        return SimpleNamespace(handle=handle)

    def get_logger(self):
        return logging.getLogger('view')

    def send(self, topic, message):
        self.waiting[topic].append(serialize_message(message))


@pytest.fixture
def queues():
    return Queues()


@pytest.fixture
def listener(queues):
    return view.ViewListener(queues)


def send_frame(queues, stamp, x):
    """A frame at (x, 0) with a scan of three points and no reflector, and its truth."""
    points = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    seen = Detections(
        stamp, 'base_link', np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0)
    )
    motion = Motion(np.zeros(3), np.eye(3))
    observation = Observation(stamp, motion, points, np.zeros(2), seen)
    T, none = np.array([x, 0.0, 0.0]), np.zeros(0, int)
    frame = Frame(stamp, observation, T, np.eye(3), T, np.eye(3), none, none, Health(Level.OK))
    queues.send('rlml/frames', build_record(make_rclpy, SessionFrame(1, frame), 'odom'))
    queues.send('deskewed_points', build_points(make_rclpy, stamp, 'base_link', points))
    queues.send('reflectors/associated', build_associated(make_rclpy, frame, 'base_link'))
    for later in range(0, 100, 20):  # [ms]: it comes more often than frames
        at, true = stamp + later * 1_000_000, np.array([x + 0.02, 0.0, 0.0])
        frames = ('map', 'base_link')
        truth = encode.odometry(make_rclpy, at, frames, true, np.zeros((3, 3)))
        queues.send('ground_truth', truth)


def send_grid(queues, stamp, cell):
    grid = OccupancyGrid(0.05, (0.0, 0.0), np.full((4, 5), cell, np.int8))
    queues.send('map', encode.occupancy_grid(make_rclpy, stamp, 'map', grid))


def polled(listener, seconds):
    """What the polls of so many seconds return."""
    out, until = [], time.monotonic() + seconds
    while time.monotonic() < until:
        out.append(listener.poll())
        time.sleep(0.005)
    return [m for m in out if m is not None]


def test_frames_carry_errors_and_the_newest_scan(queues, listener):
    for k in range(3):
        send_frame(queues, SECOND + k * SECOND // 10, float(k))
    message = listener.poll()
    frames = message['stream']['frames']
    assert frames['t'] == [0.0, 0.1, 0.2]
    assert frames['x'] == [0.0, 1.0, 2.0]
    assert frames['error'] == [2.0, 2.0, 2.0]
    assert message['scan'] == {'t': 0.2, 'x': [100, 200, 300], 'y': [0, 0, 0]}
    assert listener.poll() is None


def test_only_messages_of_a_frame_are_read(queues, listener, monkeypatch):
    read = []
    monkeypatch.setattr(
        view, 'deserialize_message',
        lambda data, kind, real=view.deserialize_message: read.append(kind) or real(data, kind),
    )  # fmt: skip
    send_frame(queues, SECOND, 0.0)
    listener.poll()
    assert [kind.__name__ for kind in read].count('Odometry') == 1
    read.clear()
    send_frame(queues, 2 * SECOND, 0.0)
    assert 'scan' not in listener.poll(is_watched=False)  # it would be read for nobody
    assert [kind.__name__ for kind in read] == ['PointCloud2', 'PointCloud2', 'Odometry']


def test_map_is_sent_when_it_changes(queues, listener, monkeypatch):
    monkeypatch.setattr(view, 'SLOWEST', 0.0)
    monkeypatch.setattr(view, 'SHARE', 0.0)
    send_grid(queues, SECOND, 0)
    assert [list(m['replace']) for m in polled(listener, 0.3)] == [['grid']]
    send_grid(queues, 2 * SECOND, 0)  # another stamp, the same cells
    assert polled(listener, 0.3) == []
    send_grid(queues, 3 * SECOND, 100)
    assert [list(m['replace']) for m in polled(listener, 0.3)] == [['grid']]


def test_map_is_left_where_it_is_while_nobody_watches(queues, listener):
    send_grid(queues, SECOND, 0)
    assert listener.poll(is_watched=False) is None
    assert len(queues.waiting['map']) == 1


def test_slow_messages_share_their_part_of_the_time(queues, listener, monkeypatch):
    """However large map, path and graph are, they get one part of SHARE together."""
    monkeypatch.setattr(view, 'SLOWEST', 0.0)
    spent = []
    for topic, slow in listener._slow.items():
        queues.waiting[topic].extend(bytes(12) + bytes([k]) for k in range(100))
        monkeypatch.setattr(slow, 'columns', lambda _: spent.append(time.sleep(0.01)) or {})
        assert slow.due == 0.0
    began = time.monotonic()
    polled(listener, 2.0)
    busy = 0.01 * len(spent)
    # the first of each is not counted: a page that opens has all at once
    busy -= 0.01 * len(listener._slow)
    assert 0 < busy <= 0.015 + 1.0 / view.SHARE * (time.monotonic() - began)


def test_first_messages_of_all_topics_are_shown_at_once(queues, listener, monkeypatch):
    shown = []
    for topic, slow in listener._slow.items():
        queues.waiting[topic].append(b'')
        monkeypatch.setattr(
            slow, 'columns', lambda _, t=topic: shown.append(t) or time.sleep(0.1) or {}
        )
    for _ in range(len(listener._slow)):
        listener._look_into_next(time.monotonic())
    assert sorted(shown) == sorted(listener._slow)
