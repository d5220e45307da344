# SPDX-License-Identifier: Apache-2.0
"""The ekf_slam node: poses, map and services, from the sample bag."""

from __future__ import annotations

import numpy as np
import pytest
from live import LATCHED, room
from std_srvs.srv import Trigger

from rlml_slam.nodes.ekf_slam import EkfSlamNode
from rlml_slam.ros.associated import read_reflector_map


@pytest.fixture
def node(live):
    live.listen('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped')
    live.listen('reflector_map_points', 'sensor_msgs/msg/PointCloud2', LATCHED)
    node = live.start(EkfSlamNode, map_update_interval=0.5)
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
    node.folder = type(node.folder)(str(tmp_path))
    answer = node.save_map(None, Trigger.Response())
    assert answer.success, answer.message
    assert (tmp_path / 'map.csv').exists()
    node.reset(None, Trigger.Response())
    assert node.estimator.filter.num_landmarks == 0
    assert not node.save_map(None, Trigger.Response()).success
