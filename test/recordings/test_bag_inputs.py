# SPDX-License-Identifier: Apache-2.0
"""What of a bag becomes input."""

from __future__ import annotations

import numpy as np

from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.types import Scan


def test_a_broken_transform_costs_none_of_its_message(tmp_path):
    bad, *good = (
        encode.transform(make_bag, 1, ('base_link', child), np.array([0.3, 0.1, 0.0]))
        for child in ('camera', 'laser', 'imu')
    )
    bad.transform.rotation.w = 0.0
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/scan', 'sensor_msgs/msg/LaserScan')
        ranges = np.ones(4, dtype=np.float32)
        scan = Scan(1, 'laser', 0.0, 0.1, 0.0, 0.1, 10.0, ranges, ranges)
        bag.write('/scan', encode.laser_scan(make_bag, scan), 1)
        bag.add_topic('/tf_static', 'tf2_msgs/msg/TFMessage', latched=True)
        bag.write('/tf_static', encode.tf_message(make_bag, [bad, *good]), 1)
    with BagReader(tmp_path / 'bag') as bag:
        extrinsics = BagInputs(bag, Parameters()).extrinsics
    assert extrinsics.pose('base_link', 'camera') is None
    for child in ('laser', 'imu'):
        np.testing.assert_allclose(extrinsics.pose('base_link', child), [0.3, 0.1, 0.0])
