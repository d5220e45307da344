# SPDX-License-Identifier: Apache-2.0
"""Map to base on /tf is the pose that was published, whoever owns odom to base there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from live import room
from tf2_rules import Buffer, Refused

from rlml_slam import se2
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.sensors import input_figures

SECOND = 1_000_000_000
MAP_ODOM, ODOM_BASE = ('map', 'odom'), ('odom', 'base_link')
ALL = 5000  # reliable: none may be lost
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
pytestmark = pytest.mark.skipif(
    rclpy_class('tf2_msgs/msg/TFMessage') is None, reason='tf2_msgs is not installed'
)


class Filter:
    """Owns odom to base, which drifts from the topic by 5 % and 3 degrees a minute."""

    def __init__(self):
        self.pose, self.before = np.array([4.0, -2.0, 0.7]), None

    def transform(self, msg):
        now = decode.stamp(msg, ''), decode.planar_pose(msg.pose.pose, '')
        if self.before is not None:
            step = se2.log(se2.between(self.before[1], now[1]))
            step[2] += math.radians(3.0) / 60.0 * (now[0] - self.before[0]) / SECOND
            self.pose = se2.compose(self.pose, se2.exp(step * [1.05, 1.0, 1.0]))
        self.before = now
        return now[0], self.pose


def start(live, **values):
    front = live.start(FrontEndNode, **values)
    back = live.start(BackEndNode, **values)
    front.sensors.stop_waiting()
    live.listen('pose', POSE, ALL)
    live.listen('/tf', 'tf2_msgs/msg/TFMessage', ALL)
    live.spin_until(lambda: front.control.session.mode and front.count_subscribers('pose') == 1)
    return front, back


def drive(live, front, back, seconds, with_topic=True):
    """The robot with such a filter; the buffer of one who hears /tf, and the topic's poses."""
    buffer, owner, topic = Buffer(kept=100 * SECOND), Filter(), {}
    for stream, msg in room(('/scan', '/odom'), seconds=seconds):
        if stream == 'odom':
            stamp, pose = owner.transform(msg)
            buffer.add(stamp, ODOM_BASE, pose)
            topic[stamp] = decode.planar_pose(msg.pose.pose, '')
            transform = encode.transform(make, stamp, ODOM_BASE, pose)
            front.sensors.add('tf', encode.tf_message(make, [transform]))
        if stream != 'odom' or with_topic:
            front.sensors.add(stream, msg)
        live.executor.spin_once(timeout_sec=0.0)
    live.spin_until(lambda: back.health.newest == front.last.stamp)
    live.drain()
    for message in live.heard['/tf']:
        for t in decode.transforms(message, '/tf'):
            if (t.parent, t.child) == MAP_ODOM:
                pose = np.array([*t.t[:2], decode.yaw(t.R, '')])
                buffer.add(decode.stamp(message.transforms[0], ''), MAP_ODOM, pose)
    return buffer, topic


def off(pose, stamp, T):
    """Distance [m] and angle [degrees] of a published pose from a transform."""
    error = se2.between(decode.planar_pose(pose.pose.pose, ''), T)
    return math.hypot(error[0], error[1]), abs(math.degrees(error[2]))


@pytest.mark.parametrize('source', ['auto', 'tf', 'topic'])
def test_map_to_base_is_the_pose_at_every_scan(live, source):
    front, back = start(live, odom_source=source)
    buffer, _ = drive(live, front, back, 20.0)
    poses = live.heard['pose'][1:]
    assert len(poses) > 50
    errors = []
    for pose in poses:
        stamp = decode.stamp(pose, '')
        errors.append(off(pose, stamp, buffer.chain(stamp, MAP_ODOM, ODOM_BASE)))
    assert np.max(errors, axis=0)[0] < 1e-3
    assert np.max(errors, axis=0)[1] < 0.01
    figures = input_figures(front.sensors.synchronizer)
    assert figures['odometry is read from'] == ('its topic' if source == 'topic' else '/tf')
    assert '% of the way' in str(figures['odometry topic against /tf'])
    assert front.sensors.synchronizer.odometry.comparison.way == pytest.approx(0.05, abs=0.01)


def test_computed_against_the_topic_it_would_be_wrong(live):
    """What was done before: map to odom against the topic is off by what the two differ."""
    front, back = start(live)
    buffer, topic = drive(live, front, back, 20.0)
    worst = 0.0
    for pose in live.heard['pose'][1:]:
        stamp = decode.stamp(pose, '')
        near = min(topic, key=lambda t: abs(t - stamp))
        T_map_odom = se2.compose(decode.planar_pose(pose.pose.pose, ''), se2.inverse(topic[near]))
        T = se2.compose(T_map_odom, buffer.at(stamp, ODOM_BASE))
        worst = max(worst, off(pose, stamp, T)[0])
    assert worst > 0.1


def test_scans_and_transforms_alone_are_enough(live):
    front, back = start(live)
    drive(live, front, back, 10.0, with_topic=False)
    assert front.last.observation.motion.known
    assert input_figures(front.sensors.synchronizer)['odometry is read from'] == '/tf'
    assert not any('odom' in problem for problem in front.problems())


def test_nothing_is_published_where_it_is_switched_off(live):
    front, back = start(live, tf_broadcast=False)
    drive(live, front, back, 3.0)
    assert live.heard['/tf'] == []
    assert back.count_publishers('/tf') == 0


def test_period_0_publishes_no_transform(live):
    front, back = start(live, transform_publish_period=0.0)
    drive(live, front, back, 3.0)
    assert live.heard['pose'] != []
    assert back.count_publishers('/tf') == 0


def test_shadow_offers_nothing_on_a_shared_name(live):
    front, back = start(live, shadow=True)
    live.listen('shadow/pose', POSE)
    live.spin_until(lambda: front.count_subscribers('shadow/pose') == 1)
    drive(live, front, back, 4.0)
    live.spin_until(lambda: back.mapper.products.stamp > 1 or back.health.newest > 0)
    assert live.heard['shadow/pose'] != []
    assert live.heard['pose'] == live.heard['/tf'] == []
    own = ('/shadow/', '/front_end/', '/back_end/', '/rosout', '/parameter_events')
    for node in (front, back):
        name, space = node.get_name(), node.get_namespace()
        for topic, _ in node.get_publisher_names_and_types_by_node(name, space):
            assert topic.startswith(own), topic
        for service, _ in node.get_service_names_and_types_by_node(name, space):
            assert service.startswith(own), service


def test_odometry_is_provided_where_there_is_none(live):
    front, back = start(live, provide_odom_frame=True, use_odom=False)
    live.spin_until(lambda: front.count_subscribers('rlml/frames') == 1)
    for stream, msg in room(('/scan',), seconds=8.0):
        front.sensors.add(stream, msg)
        # A transform that comes late has a newer stamp than the pose it is compared with.
        live.spin_until(lambda: front.last and back.health.newest == front.last.stamp)
    live.drain()
    buffer = Buffer()
    for message in live.heard['/tf']:
        for m in message.transforms:
            (t,) = decode.transforms(m, '/tf')
            pose = np.array([*t.t[:2], decode.yaw(t.R, '')])
            buffer.add(decode.stamp(m, ''), (t.parent, t.child), pose)
    compared = 0
    for pose in live.heard['pose'][1:]:
        stamp = decode.stamp(pose, '')
        if stamp in buffer.poses[MAP_ODOM]:  # else the back end has not come that far
            compared += 1
            T = buffer.chain(stamp, MAP_ODOM, ODOM_BASE)
            assert off(pose, stamp, T)[0] < 1e-6
    assert compared > 50, compared


def test_what_is_refused_is_refused():
    buffer = Buffer()
    buffer.add(5, MAP_ODOM, np.zeros(3))
    buffer.add(9, MAP_ODOM, np.ones(3))
    np.testing.assert_allclose(buffer.at(7, MAP_ODOM), 0.5)
    for stamp in (4, 10):
        with pytest.raises(Refused):
            buffer.at(stamp, MAP_ODOM)
