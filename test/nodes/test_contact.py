# SPDX-License-Identifier: Apache-2.0
"""Messages that nobody should send, over DDS: poses go on, and a signal is answered."""

from __future__ import annotations

import time

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseArray
from live import room
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.point_cloud import build_cloud
from rlml_slam.ros.message_guard import guard_of

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
POINT = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('intensity', '<f4')])
LATE = 0.5  # [s] from scan to pose, on a machine that does other things as well


def of_a_3d_lidar():
    cloud = PointCloud2()
    cloud.header.frame_id, cloud.header.stamp.sec = 'laser', 1
    return build_cloud(make, cloud.header, np.ones(100_000, dtype=POINT))


def without_fields():
    return PointCloud2(height=1, width=3, point_step=0)


def endless():
    x = PointField(name='x', offset=0, datatype=PointField.FLOAT32, count=1)
    cloud = PointCloud2(height=2**31, width=1, point_step=4, row_step=0, fields=[x])
    cloud.data = bytes(4)
    return cloud


def many_poses():
    return PoseArray(poses=[Pose()] * 100_000)


@pytest.mark.parametrize(
    ('topic', 'bad'),
    [
        ('reflectors', of_a_3d_lidar),
        ('reflectors', without_fields),
        ('reflectors', endless),
        ('reflector_poses', many_poses),
    ],
)
def test_message_of_another_sensor_delays_no_pose(live, topic, bad):
    node = live.start(FrontEndNode, laser_pose=[0.2, 0.0, 0.0])
    node.sensors.stop_waiting()
    live.listen('pose', POSE)
    message = bad()
    kind, data = type(message), serialize_message(message)
    good = list(room(['/scan', '/odom'], seconds=3.0))
    out = {s: live.ear.create_publisher(type(m), s, 100) for s, m in good}
    out[topic] = live.ear.create_publisher(kind, topic, 10)
    live.spin_until(lambda: all(p.get_subscription_count() for p in out.values()))
    waited, scans = [], 0
    for stream, msg in good:
        if stream == 'scan':
            out[topic].publish(data)
            began, scans = time.monotonic(), scans + 1
        out[stream].publish(msg)
        if stream == 'scan' and scans > 3:
            # a scan has its pose where the odometry after it has come
            live.spin_until(lambda n=scans - 3: len(live.heard['pose']) >= n)
            waited.append(time.monotonic() - began)
    assert len(waited) > 20
    # the first ones load kernels
    assert max(waited[5:]) < LATE
    counts = node.sensors.synchronizer.inputs.totals().get('reflectors', {})
    assert guard_of(node).refused[topic] + counts.get('invalid', 0) > 20


def test_signal_is_answered_while_a_3d_lidar_publishes(live, start):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    both = start('slam')
    data = serialize_message(of_a_3d_lidar())
    out = live.ear.create_publisher(PointCloud2, 'reflectors', 10)
    live.spin_until(lambda: out.get_subscription_count() == 1, timeout=60.0)
    # it subscribes before it spins
    live.spin_until(lambda: live.heard['/diagnostics'], timeout=60.0)
    end = time.monotonic() + 2.0
    while time.monotonic() < end:
        out.publish(data)
        live.executor.spin_once(timeout_sec=0.01)
    began = time.monotonic()
    both.interrupt()
    code, said = both.finish()
    assert time.monotonic() - began < 5.0
    assert code == 0, said
    assert 'reflectors: 1600' in said, said
    assert said.count('not used: reflectors') == 1, said
