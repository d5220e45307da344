# SPDX-License-Identifier: Apache-2.0
"""The ekf_slam node: poses, map and services, from the sample bag."""

from __future__ import annotations

import numpy as np
import pytest
from live import LATCHED, room
from nav_msgs.srv import LoadMap
from numpy.testing import assert_allclose
from std_srvs.srv import Trigger

from rlml_slam.errors import InputError
from rlml_slam.nodes.ekf_slam import EkfSlamNode
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map


@pytest.fixture
def node(live, tmp_path):
    live.listen('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped')
    live.listen('reflector_map_points', 'sensor_msgs/msg/PointCloud2', LATCHED)
    node = live.start(EkfSlamNode, map_update_interval=0.5, map_directory=str(tmp_path))
    node.sensors.stop_waiting()
    live.spin_until(lambda: node.count_subscribers('pose') == 1)
    return node


def test_every_scan_is_answered_and_the_landmarks_are_published(live, node, tmp_path):
    scans = 0
    for stream, msg in room(seconds=3.0):
        node.sensors.add(stream, msg)
        scans += stream == 'scan'
    live.spin_until(lambda: len(live.heard['pose']) >= scans - 3)
    live.spin_until(lambda: len(live.heard['reflector_map_points']) >= 1)
    landmarks = read_reflector_map(live.heard['reflector_map_points'][-1])
    assert len(landmarks) >= 3
    assert np.isfinite(landmarks.cov).all()
    services = node.map_services
    answer = services.save_map(None, Trigger.Response())
    assert answer.success, answer.message
    assert (tmp_path / 'map.csv').exists()
    services.reset(None, Trigger.Response())
    assert node.estimator.filter.num_landmarks == 0
    assert not services.save_map(None, Trigger.Response()).success


def test_robot_without_odometry_is_given_one(live):
    topic, kind = '/tf', 'tf2_msgs/msg/TFMessage'
    if rclpy_class(kind) is None:
        topic, kind = '/ekf_slam/odom_to_base', 'geometry_msgs/msg/TransformStamped'
    live.listen(topic, kind)
    node = live.start(EkfSlamNode, use_odom=False, provide_odom_frame=True)
    node.sensors.stop_waiting()
    live.spin_until(lambda: node.count_subscribers(topic) == 1)
    for stream, msg in room(('/scan',), seconds=2.0):
        node.sensors.add(stream, msg)
    live.spin_until(
        lambda: any(
            (t.parent, t.child) == ('odom', 'base_link')
            for m in live.heard[topic] for t in decode.transforms(m)
        )
    )  # fmt: skip


def test_start_pose_of_another_frame_changes_nothing(live, node):
    there, cov = np.array([5.0, -2.0, 1.0]), 0.04 * np.eye(3)
    node.start_at(encode.pose_with_covariance(make, 0, 'map', there, cov))
    assert_allclose(node.estimator.filter.pose, there)
    with pytest.raises(InputError, match="frame_id is 'odom' instead"):
        node.start_at(encode.pose_with_covariance(make, 0, 'odom', np.zeros(3), cov))
    wrong = np.array([[0.1, 0.5, 0.0], [0.5, 0.1, 0.0], [0.0, 0.0, 0.1]])
    with pytest.raises(InputError, match='eigenvalue'):
        node.start_at(encode.pose_with_covariance(make, 0, 'map', np.zeros(3), wrong))
    assert_allclose(node.estimator.filter.pose, there)


def test_a_loaded_map_is_localised_in_and_not_extended(live, node, tmp_path):
    for stream, msg in room(seconds=3.0):
        node.sensors.add(stream, msg)
    live.spin_until(lambda: len(live.heard['reflector_map_points']) >= 1)
    services = node.map_services
    assert services.save_map(None, Trigger.Response()).success
    saved = node.estimator.reflectors()
    services.load_map(LoadMap.Request(map_url='nowhere'), answer := LoadMap.Response())
    assert answer.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    assert node.estimator.filter.num_landmarks == len(saved) > 0
    services.load_map(LoadMap.Request(map_url='map'), answer := LoadMap.Response())
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    assert_allclose(node.estimator.reflectors().points, saved.points, atol=1e-6)
    heard = len(live.heard['pose'])
    for stream, msg in room(seconds=3.0):
        node.sensors.add(stream, msg)
    live.spin_until(lambda: len(live.heard['pose']) >= heard + 20)
    assert len(node.estimator.reflectors()) == len(saved)
    # a reset forgets where the robot is, not the map
    services.reset(None, Trigger.Response())
    assert node.estimator.filter.num_landmarks == len(saved)
