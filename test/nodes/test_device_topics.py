# SPDX-License-Identifier: Apache-2.0
"""Reflectors of a device reach the front end over DDS, and nonsense on its topic costs nothing."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose
from nav_msgs.msg import Odometry
from visualization_msgs.msg import Marker, MarkerArray

from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.point_cloud import build_cloud

PERIOD = 100_000_000  # [ns]
PLACES = ((2.0, 1.0), (-1.0, 3.0))


def stamped(header, stamp, frame='base_link'):
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    header.frame_id = frame


def nav_reflectors(stamp, places, frame='base_link'):
    """As sick_scan_xd sends them: DELETEALL, then a cylinder and a text for each."""
    out = [Marker(action=Marker.DELETEALL)]
    for k, (x, y) in enumerate(places):
        at = Pose(position=Point(x=x, y=y))
        out.append(Marker(action=Marker.ADD, type=Marker.CYLINDER, id=k, pose=at))
        text = Marker(action=Marker.ADD, type=Marker.TEXT_VIEW_FACING, id=k + len(places))
        out.append(text)
    for marker in out:
        stamped(marker.header, stamp, frame)
    return MarkerArray(markers=out)


def test_markers_of_a_nav350_become_detections(live):
    node = live.start(FrontEndNode, use_scan=False)
    odom = live.ear.create_publisher(Odometry, 'odom', 50)
    markers = live.ear.create_publisher(MarkerArray, 'nav_reflectors', 50)
    live.spin_until(lambda: odom.get_subscription_count() and markers.get_subscription_count())
    sent = iter(range(1, 2000))

    def seen():
        k = next(sent)
        step = Odometry(child_frame_id='base_link')
        stamped(step.header, k * PERIOD, 'odom')
        step.pose.pose.orientation.w = 1.0
        odom.publish(step)
        # an empty array, one in a frame that nobody knows, and a position that is none
        markers.publish(MarkerArray())
        markers.publish(nav_reflectors(k * PERIOD, PLACES, 'nowhere'))
        markers.publish(nav_reflectors(k * PERIOD, [(float('nan'), 1.0)]))
        markers.publish(nav_reflectors(k * PERIOD, PLACES))
        last = node.last
        detections = None if last is None else last.observation.detections
        return detections is not None and len(detections) == len(PLACES)

    live.spin_until(seen, timeout=60.0, what='no detections')
    np.testing.assert_allclose(node.last.observation.detections.points, PLACES, atol=1e-6)
    assert (node.last.observation.detections.ids == -1).all()


def test_full_frame_of_a_picoscan_is_not_too_large(live):
    """Three echoes of 2760 beams, with all the fields that a user may choose."""
    node = live.start(FrontEndNode)
    node.sensors.stop_waiting()
    floats = ('x', 'y', 'z', 'i', 'range', 'azimuth', 'elevation')
    bits = ('layer', 'echo', 'reflector')
    points = np.zeros(3 * 2760, [(f, '<f4') for f in floats] + [(b, 'i1') for b in bits])
    points['x'], points['y'] = 5.0, np.linspace(-9.0, 9.0, len(points))
    points['reflector'][::900] = 1
    kind = rclpy_class('sensor_msgs/msg/PointCloud2')
    clouds = live.ear.create_publisher(kind, 'reflectors', 50)
    live.spin_until(clouds.get_subscription_count)
    clouds.publish(build_cloud(make_rclpy, encode.header(make_rclpy, PERIOD, 'base_link'), points))
    inputs, guard = node.sensors.synchronizer.inputs, node.message_guard
    live.spin_until(lambda: guard.refused or 'reflectors' in inputs.totals())
    assert guard.figures() == {}
