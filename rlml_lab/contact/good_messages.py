# SPDX-License-Identifier: Apache-2.0
"""One good message of every topic that the nodes listen to, to be mutated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.correction_message import build_correction
from rlml_slam.ros.codecs.frame_messages import build_points, build_record
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import build_associated, build_reflector_map
from rlml_slam.ros.codecs.request_message import build_request
from rlml_slam.slam.conversation import Correct, Relocate, SessionFrame, StartSession
from rlml_slam.types import Reflectors

ROOM = Path(__file__).resolve().parents[2] / 'bags' / 'room'
STREAMS = {'/scan': 'scan', '/odom': 'odom', '/imu': 'imu', '/reflectors': 'reflectors'}
SECOND = 1_000_000_000


def stream_of_room(seconds: float = 30.0) -> list[tuple[str, Any]]:
    """(stream, message) of the sample bag, as rclpy delivers them."""
    with BagReader(ROOM) as bag:
        kinds = {t.name: rclpy_class(t.msgtype) for t in bag.topics.values()}
        return [
            (STREAMS[topic], deserialize_message(data, kinds[topic]))
            for stamp, topic, data in bag.serialized(tuple(STREAMS))
            if stamp <= bag.start + seconds * 1e9
        ]


def private_messages(record: SessionFrame) -> dict[str, list[Any]]:
    """Messages of the topics between front end and back end, by topic."""
    frame, pose, cov = record.frame, np.array([1.0, 2.0, 0.3]), 1e-4 * np.eye(3)
    n = 4
    map_ = Reflectors(
        np.arange(n, dtype=np.int64), np.arange(2.0 * n).reshape(n, 2),
        np.broadcast_to(1e-4 * np.eye(2), (n, 2, 2)).copy(), np.full(n, -1, dtype=np.int64),
        np.full(n, 5, dtype=np.int64), np.full(n, 0.06),
    )  # fmt: skip
    grid = OccupancyGrid(0.05, (0.0, 0.0), np.zeros((40, 40), dtype=np.int8))
    numbers = (record.session, frame.stamp)
    correct = Correct(*numbers, pose, cov, (3, 4))
    starts = [kind(7, *numbers, pose, cov) for kind in (StartSession, Relocate)]
    assert frame.observation.points is not None
    return {
        'initialpose': [encode.pose_with_covariance(make, frame.stamp, 'map', pose, cov)],
        'rlml/graph_correction': [build_correction(make, correct, 'map')],
        'rlml/session_start': [build_request(make, start, 'map') for start in starts],
        'rlml/localization_grid': [encode.occupancy_grid(make, 9, 'map', grid)],
        'rlml/localization_map': [build_reflector_map(make, 9, 'map', map_)],
        'rlml/map_entry': [make('std_msgs/msg/String', data='not yet in the map')],
        'rlml/frames': [build_record(make, record, 'rlml_local')],
        'deskewed_points': [
            build_points(make, frame.stamp, 'base_link', frame.observation.points)
        ],
        'reflectors/associated': [build_associated(make, frame, 'base_link')],
    }
