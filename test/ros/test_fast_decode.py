# SPDX-License-Identifier: Apache-2.0
"""What is read briefly is what the library reads, as far as ros/convert.py asks for it."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.fast_decode import LaserScan, laser_scan, odometry
from rlml_slam.ros.codecs.message_types import bag_types, make_bag
from rlml_slam.types import Scan

STAMP = 1_234_567_890_123_456_789
ODOMETRY, SCAN = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/LaserScan'


def odom_bytes(frames):
    pose = np.array([1.5, -2.25, 0.7])
    message = encode.odometry(make_bag, STAMP, frames, pose, np.eye(3))
    return bytes(bag_types().serialize_cdr(message, ODOMETRY))


def scan_bytes(frame, beams, intensities):
    rng = np.random.default_rng(beams)
    ranges = rng.random(beams).astype(np.float32)
    scan = Scan(
        STAMP, frame, -1.5, 0.01, 1e-4, 0.1, 30.0, ranges, ranges[: beams if intensities else 0]
    )
    return bytes(bag_types().serialize_cdr(encode.laser_scan(make_bag, scan), SCAN))


# names of every length there is between two aligned numbers
@pytest.mark.parametrize('child', ['', 'b', 'ba', 'bas', 'base', 'base_', 'base_l', 'base_li'])
@pytest.mark.parametrize('parent', ['odom', 'odom1', 'ödom', ''])
def test_odometry_is_what_the_library_reads(parent, child):
    raw = odom_bytes((parent, child))
    one = decode.odometry(bag_types().deserialize_cdr(raw, ODOMETRY))
    other = decode.odometry(odometry(raw))
    assert one.stamp == other.stamp == STAMP
    assert one.pose.tobytes() == other.pose.tobytes()
    assert odometry(raw).header.frame_id == parent


@pytest.mark.parametrize('frame', ['', 'l', 'la', 'las', 'laser'])
@pytest.mark.parametrize('intensities', [False, True])
@pytest.mark.parametrize('beams', [0, 1, 181])
def test_scan_is_what_the_library_reads(frame, beams, intensities):
    raw = scan_bytes(frame, beams, intensities)
    one = decode.scan(bag_types().deserialize_cdr(raw, SCAN))
    other = decode.scan(laser_scan(raw))
    for name in Scan.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        assert np.array_equal(a, b), name
    assert other.ranges.dtype == np.float32


@pytest.mark.parametrize('share', [0.1, 0.5, 0.9])
@pytest.mark.parametrize(
    ('read', 'raw'),
    [(odometry, odom_bytes(('odom', 'base'))), (laser_scan, scan_bytes('l', 9, True))],
)
def test_what_ends_too_early_is_refused(read, raw, share):
    with pytest.raises((ValueError, struct.error)):
        read(raw[: int(share * len(raw))])


def test_other_encodings_are_left_to_the_library():
    raw = b'\x00\x00' + odom_bytes(('odom', 'base'))[2:]
    with pytest.raises(ValueError, match='encoded in another way'):
        odometry(raw)


def test_bag_gives_brief_messages_only_where_they_need_not_be_whole(tmp_path):
    ranges = np.ones(4, np.float32)
    scan = Scan(STAMP, 'laser', 0.0, 0.1, 0.0, 0.1, 9.0, ranges, ranges)
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/scan', encode.laser_scan(make_bag, scan), STAMP)
        odom = encode.odometry(make_bag, STAMP, ('odom', 'base'), np.zeros(3), np.eye(3))
        bag.write('/odom', odom, STAMP)
    with BagReader(tmp_path / 'bag') as bag:
        whole = {topic: m for _, topic, m in bag.messages()}
        brief = {topic: m for _, topic, m in bag.messages(whole=False)}
    assert isinstance(brief['/scan'], LaserScan)
    assert not isinstance(whole['/scan'], LaserScan)
    assert len(whole['/odom'].pose.covariance) == 36
    assert not hasattr(brief['/odom'].pose, 'covariance')
