# SPDX-License-Identifier: Apache-2.0
"""Odometry out of /tf, whatever frames lie between odom and base."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.ros.tf_odometry import TfOdometry

MOUNT = np.array([0.2, -0.1, 0.3])


def transform(stamp, parent, child, pose):
    return encode.transform(make_bag, stamp, (parent, child), np.asarray(pose, dtype=float))


def follow(*static):
    tree = Extrinsics()
    for parent, child, pose in static:
        tree.add(decode.transforms(transform(1, parent, child, pose)))
    return TfOdometry(tree, 'odom', 'base_link', 'map')


def samples(tf, *messages):
    return [s for m in messages for s in tf.add(m)]


def drive(k):
    return np.array([0.1 * k, 0.02 * k, 0.05 * k])


def test_pose_and_stamp_of_the_transform_are_the_sample():
    tf = follow()
    found = samples(tf, *(transform(k, 'odom', 'base_link', drive(k)) for k in (1, 2, 3)))
    assert [s.stamp for s in found] == [1, 2, 3]
    np.testing.assert_allclose([s.pose for s in found], [drive(k) for k in (1, 2, 3)], atol=1e-12)


def test_leading_slashes_of_ros1_are_the_same_frames():
    (found,) = samples(follow(), transform(7, '/odom', '/base_link', drive(1)))
    np.testing.assert_allclose(found.pose, drive(1), atol=1e-12)


@pytest.mark.parametrize('on_tf', [False, True])
def test_a_footprint_in_between_is_composed(on_tf):
    static = ('base_footprint', 'base_link', MOUNT)
    tf = follow() if on_tf else follow(static)
    found = []
    for k in (1, 2, 3):
        if on_tf:  # as robot_state_publisher of ROS 1 does, with stamps of its own
            found += samples(tf, transform(1000 + k, *static))
        found += samples(tf, transform(k, 'odom', 'base_footprint', drive(k)))
    assert [s.stamp for s in found] == [1, 2, 3]
    want = [se2.compose(drive(k), MOUNT) for k in (1, 2, 3)]
    np.testing.assert_allclose([s.pose for s in found], want, atol=1e-12)


def test_the_transform_that_moves_gives_the_stamp():
    tf = follow()
    found = []
    for k in range(1, 5):  # odom to the footprint stands still, the base moves in it
        found += samples(
            tf,
            transform(100 * k, 'odom', 'base_footprint', MOUNT),
            transform(100 * k + 3, 'base_footprint', 'base_link', drive(k)),
        )
    assert [s.stamp for s in found if s.stamp > 200] == [203, 303, 403]
    np.testing.assert_allclose(found[-1].pose, se2.compose(MOUNT, drive(4)), atol=1e-12)


def test_an_inverted_transform_is_inverted_back():
    (found,) = samples(follow(), transform(5, 'base_link', 'odom', se2.inverse(drive(2))))
    np.testing.assert_allclose(found.pose, drive(2), atol=1e-12)


def test_a_localization_is_no_odometry():
    """Some robots have map to base_link: odom and base are then connected by way of the map."""
    tf = follow()
    found = samples(
        tf, transform(1, 'map', 'odom', MOUNT), transform(2, 'map', 'base_link', drive(1))
    )
    assert found == []
    assert tf.path == ()


def test_sensors_have_their_place_on_tf_as_well():
    tf = follow()
    samples(tf, transform(1, 'odom', 'base_link', drive(1)))
    samples(tf, transform(2, 'base_link', 'laser', MOUNT))
    np.testing.assert_allclose(tf.tree.pose('base_link', 'laser'), MOUNT, atol=1e-12)
