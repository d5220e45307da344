# SPDX-License-Identifier: Apache-2.0
"""Reflectors in the messages of devices: what is read, and what is refused."""

from __future__ import annotations

from types import SimpleNamespace as Message

import numpy as np
import pytest

from rlml_slam.errors import InputError
from rlml_slam.params import Parameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.device_reflectors import as_poses, grouped, is_device, read
from rlml_slam.types import ANONYMOUS

MOST = 10_000
TEXT, DELETEALL = 9, 3


def header(frame='nav', sec=7):
    return Message(stamp=Message(sec=sec, nanosec=5), frame_id=frame)


def marker(x=0.0, y=0.0, kind=3, action=0, number=0, frame='nav'):
    position = Message(x=x, y=y, z=0.0)
    return Message(
        header=header(frame), action=action, type=kind, id=number, pose=Message(position=position)
    )


def of_nav350(*places, frame='nav'):
    """DELETEALL, then a cylinder and the text beside it for each reflector."""
    out = [marker(action=DELETEALL, kind=0, frame=frame)]
    for k, (x, y) in enumerate(places):
        out.append(marker(x, y, number=k, frame=frame))
        out.append(marker(x, y + 0.12, kind=TEXT, number=k + len(places), frame=frame))
    return Message(markers=out)


def test_markers_of_a_nav350_are_anonymous_reflectors():
    msg = of_nav350((1.0, 2.0), (-3.0, 0.5))
    assert is_device(msg)
    seen = decode.detections_of_poses(as_poses(msg, MOST), Parameters().reflector)
    np.testing.assert_array_equal(seen.points, [[1.0, 2.0], [-3.0, 0.5]])
    assert list(seen.ids) == [ANONYMOUS] * 2  # marker.id counts from 0 in each message
    assert (seen.stamp, seen.frame_id) == (7_000_000_005, 'nav')


def test_deleteall_alone_says_that_none_was_seen():
    points, ids = read(of_nav350(), MOST)
    assert points.shape == (0, 2)
    assert len(ids) == 0


def test_array_without_any_marker_has_no_stamp():
    with pytest.raises(InputError, match='has no stamp'):
        as_poses(Message(markers=[]), MOST)


def test_markers_in_two_frames_are_refused():
    msg = of_nav350((1.0, 2.0))
    msg.markers.append(marker(frame='map'))
    with pytest.raises(InputError, match="several frames, the first is 'nav'"):
        read(msg, MOST)


def test_array_of_something_else_is_refused_by_its_size():
    with pytest.raises(InputError, match='21 markers, more than 20'):
        read(of_nav350(*[(1.0, k) for k in range(10)]), 20)


def cloud(x, y, bit):
    """A full frame of a picoScan with the fields that a user chose."""
    dtype = np.dtype([('x', '<f4'), ('y', '<f4'), ('i', '<f4'), ('reflector', 'u1')])
    points = np.zeros(len(x), dtype)
    points['x'], points['y'], points['reflector'] = x, y, bit
    numbers = {'f': 7, 'u': 2}
    fields = [
        Message(name=n, offset=dtype.fields[n][1], datatype=numbers[dtype[n].kind], count=1)
        for n in dtype.names
    ]
    return Message(
        header=header('lidar'), height=1, width=len(x), fields=fields, is_bigendian=False,
        point_step=dtype.itemsize, row_step=dtype.itemsize * len(x), data=points.tobytes(),
        is_dense=True,
    )  # fmt: skip


def test_reflector_bit_of_a_cloud_gives_one_reflector_per_group():
    a = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    r = np.where(np.abs(np.abs(a) - np.pi) < 0.02, 2.0, 5.0)  # one is right behind
    bit = (np.abs(np.abs(a) - np.pi) < 0.02) | (np.abs(a - 1.0) < 0.01)
    msg = cloud(r * np.cos(a), r * np.sin(a), bit)
    assert is_device(msg)
    points, ids = read(msg, MOST)
    order = np.argsort(points[:, 0])
    np.testing.assert_allclose(
        points[order], [[-2.0, 0.0], [5.0 * np.cos(1.0), 5.0 * np.sin(1.0)]], atol=0.02
    )
    assert set(ids.tolist()) == {ANONYMOUS}
    with pytest.raises(InputError, match='720 x 1 points, more than 500'):
        read(msg, 500)


def test_cloud_of_detections_is_no_scan():
    plain = cloud(np.ones(2), np.ones(2), np.ones(2))
    plain.fields = plain.fields[:2]
    assert not is_device(plain)


def extended(status, ranges):
    scan = Message(
        header=header('scanner'), angle_min=-0.5, angle_increment=0.01, range_min=0.05,
        range_max=40.0, ranges=np.asarray(ranges, np.float32),
    )  # fmt: skip
    return Message(laser_scan=scan, reflektor_status=list(status), reflektor_median=[])


def test_reflector_bit_of_a_safety_scanner():
    status, ranges = np.zeros(100, bool), np.full(100, 8.0)
    status[[40, 41, 42, 70]] = True
    ranges[40:43] = 4.0
    status[90], ranges[90] = True, np.inf  # a beam that hit nothing
    points, _ = read(extended(status, ranges), MOST)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(np.sort(bearing), [-0.09, 0.2], atol=1e-6)
    np.testing.assert_allclose(np.hypot(*points.T), [4.0, 8.0], atol=1e-3)
    with pytest.raises(InputError, match='99 reflektor_status for 100 ranges'):
        read(extended(status[1:], ranges), MOST)


def landmark(name, x, y, weight=1e5):
    pose = Message(position=Message(x=x, y=y, z=0.0))
    return Message(id=name, tracking_from_landmark_transform=pose, translation_weight=weight)


def test_landmarks_of_cartographer_keep_their_identity():
    names = [('12', 1.0, 2.0), ('gate A', 3.0, 4.0), ('', 5.0, 6.0)]
    msg = Message(header=header('base_link'), landmarks=[landmark(*n) for n in names])
    msg.landmarks.append(landmark('off', 0.0, 0.0, weight=0.0))
    points, ids = read(msg, MOST)
    np.testing.assert_array_equal(points, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert ids[0] == 12
    assert ids[1] > 0
    assert ids[2] == ANONYMOUS
    again, _ = read(msg, MOST), None
    np.testing.assert_array_equal(again[1], ids)


def test_groups_of_points_that_are_no_numbers():
    assert grouped(np.array([[np.nan, 1.0], [np.inf, 0.0]])).shape == (0, 2)
    np.testing.assert_array_equal(grouped(np.array([[1.0, 0.0]])), [[1.0, 0.0]])
    np.testing.assert_allclose(grouped(np.array([[1.0, 0.0], [1.0, 0.1]])), [[1.0, 0.05]])


@pytest.mark.parametrize('x', [float('nan'), float('inf'), 1e30])
def test_positions_that_make_no_sense_are_refused(x):
    with pytest.raises(InputError):
        decode.detections_of_poses(as_poses(of_nav350((x, 1.0)), MOST), Parameters().reflector)
