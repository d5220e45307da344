# SPDX-License-Identifier: Apache-2.0
"""What of a bag becomes input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.types import Scan

ROOM = Path(__file__).resolve().parents[2] / 'bags' / 'room'
PLACE = np.array([0.3, 0.1, 0.0])


def scan_in(frame):
    ranges = np.ones(4, dtype=np.float32)
    return encode.laser_scan(make_bag, Scan(1, frame, 0.0, 0.1, 0.0, 0.1, 10.0, ranges, ranges))


def changed_node(**values):
    return replace(Parameters(), node=replace(Parameters().node, **values))


def inputs_of(path, params):
    with BagReader(path) as bag:
        return BagInputs(bag, params)


@pytest.mark.parametrize('source', ['auto', 'topic'])
def test_place_that_comes_late_on_tf_is_found(source, tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/scan', scan_in('laser'), 1)
        for k in range(1, 700):
            pose = np.array([1e-3 * k, 0.0, 0.0])
            moved = encode.transform(make_bag, k, ('odom', 'base_link'), pose)
            bag.write('/tf', encode.tf_message(make_bag, [moved]), k)
        placed = encode.transform(make_bag, 700, ('base_link', 'laser'), PLACE)
        bag.write('/tf', encode.tf_message(make_bag, [placed]), 700)
    inputs = inputs_of(tmp_path / 'bag', changed_node(odom_source=source))
    np.testing.assert_allclose(inputs.extrinsics.pose('base_link', 'laser'), PLACE)
    assert inputs.sources()['scan'] == '/scan'


def test_place_that_nobody_tells_is_told(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/scan', scan_in('base_link'), 1)
        bag.write('/rear', scan_in('rear'), 1)
    params = changed_node(scan_topics=('scan', 'rear'), laser_pose=(0.2, 0.0, 0.0))
    note = "no transform from base_link to 'rear': laser_pose is used: [0.2, 0.0, 0.0]"
    assert inputs_of(tmp_path / 'bag', params).sources()['scan'] == f'/scan, /rear; {note}'
    without = inputs_of(tmp_path / 'bag', changed_node(scan_topic='scan'))
    assert without.sources()['scan'] == '/scan'  # in the frame of the base itself


def test_a_broken_transform_costs_none_of_its_message(tmp_path):
    bad, *good = (
        encode.transform(make_bag, 1, ('base_link', child), np.array([0.3, 0.1, 0.0]))
        for child in ('camera', 'laser', 'imu')
    )
    bad.transform.rotation.w = 0.0
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/scan', 'sensor_msgs/msg/LaserScan')
        bag.write('/scan', scan_in('laser'), 1)
        bag.add_topic('/tf_static', 'tf2_msgs/msg/TFMessage', latched=True)
        bag.write('/tf_static', encode.tf_message(make_bag, [bad, *good]), 1)
    with BagReader(tmp_path / 'bag') as bag:
        extrinsics = BagInputs(bag, Parameters()).extrinsics
    assert extrinsics.pose('base_link', 'camera') is None
    for child in ('laser', 'imu'):
        np.testing.assert_allclose(extrinsics.pose('base_link', child), [0.3, 0.1, 0.0])


def test_ids_that_count_the_rows_of_each_message_change_nothing(tmp_path):
    """As if they were not there; taken for names, one of the seven reflectors is missing."""
    with BagReader(ROOM) as source, BagWriter(tmp_path / 'counted') as bag:
        for topic in source.topics.values():
            bag.add_topic(topic.name, topic.msgtype, source.is_latched(topic.name))
        for time, topic, message in source.messages():
            if topic == '/reflectors':
                seen = decode.detections(message, Parameters().reflector)
                ids = np.arange(len(seen), dtype=np.int64)
                message = encode.detections(make_bag, replace(seen, ids=ids))
            bag.write(topic, message, time)
    plain, counted = (replay(bag, Parameters()) for bag in (ROOM, tmp_path / 'counted'))
    assert np.array_equal(counted.frames.poses, plain.frames.poses)
    assert counted.reflectors.points.tobytes() == plain.reflectors.points.tobytes()
