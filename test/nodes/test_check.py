# SPDX-License-Identifier: Apache-2.0
"""``rlml check`` hears a live robot, and names what is wrong with it."""

from __future__ import annotations

import copy
import json
import threading
import time

import numpy as np
import pytest
from live import BEST_EFFORT, DOMAIN, LATCHED, room
from rclpy.qos import QoSProfile

from rlml_slam.cli.main import main
from rlml_slam.cli.support.processes import free_domain
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class

TF = 'tf2_msgs/msg/TFMessage'
SECOND = 1_000_000_000
BEGIN, SECONDS = 7.0, 4.0  # of the drive: the robot turns by 90 degrees
pytestmark = pytest.mark.skipif(rclpy_class(TF) is None, reason='tf2_msgs is not installed')
PLACE = np.array([0.2, 0.0, 0.0])


class Robot:
    """Publishes a part of the sample drive as it was recorded; ``edit`` may change messages."""

    def __init__(
        self, live, edit=lambda topic, msg: [msg], place=PLACE, odom_qos=10, namespace=None
    ):
        from rclpy.node import Node

        words = ['--ros-args', '-r', '/tf:=tf', '-r', '/tf_static:=tf_static']
        self.node = live.add(
            Node('robot', context=live.context, namespace=namespace, cli_args=namespace and words)
        )
        self.edit, self.place = edit, place
        self.publishers = {
            '/scan': self.node.create_publisher(
                rclpy_class('sensor_msgs/msg/LaserScan'), 'scan', BEST_EFFORT),
            '/odom': self.node.create_publisher(
                rclpy_class('nav_msgs/msg/Odometry'), 'odom', odom_qos),
            '/tf': self.node.create_publisher(rclpy_class(TF), '/tf', 100),
        }  # fmt: skip
        self.static = self.node.create_publisher(rclpy_class(TF), '/tf_static', LATCHED)
        self.messages = list(room(('/scan', '/odom'), seconds=BEGIN + SECONDS + 3.0))
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._drive)
        self.thread.start()

    def close(self):
        self.ended.set()
        self.thread.join()

    def _publish(self, topic, msg):
        for edited in self.edit(topic, msg):
            self.publishers[topic].publish(edited)

    def _wait_for_a_listener(self):
        """However long the command takes to start, it sees the same part of the drive."""
        end = time.monotonic() + 20.0
        while not self.publishers['/scan'].get_subscription_count() and time.monotonic() < end:
            if self.ended.wait(0.02):
                return

    def _drive(self):
        laser = encode.transform(make_rclpy, 1, ('base_link', 'laser'), self.place)
        for edited in self.edit('/tf_static', laser):
            self.static.publish(encode.tf_message(make_rclpy, [edited]))
        self._wait_for_a_listener()
        first = decode.stamp(self.messages[0][1], '') + int(BEGIN * SECOND)
        began, clock = time.monotonic(), self.node.get_clock().now().nanoseconds
        for stream, msg in self.messages:
            stamp = decode.stamp(msg, '')
            if stamp < first:
                continue
            ahead = 1e-9 * (stamp - first) - (time.monotonic() - began)
            if self.ended.wait(max(ahead, 0.0)):
                return
            now = clock + stamp - first
            msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(now, SECOND)
            self._publish(f'/{stream}', msg)
            if stream == 'odom':
                pose = decode.planar_pose(msg.pose.pose, '')
                t = encode.transform(make_rclpy, now, ('odom', 'base_link'), pose)
                self._publish('/tf', encode.tf_message(make_rclpy, [t]))


@pytest.fixture
def checked(live, monkeypatch, capsys):
    """Runs the command beside a robot that is made of its arguments."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    robots = []

    def check(*more, **robot):
        robots.append(Robot(live, **robot))
        for add in more:
            add(robots[-1].node)
        words = ['--namespace', robot['namespace']] if 'namespace' in robot else []
        code = main(['check', '--seconds', str(SECONDS), '--json', *words])
        found = json.loads(capsys.readouterr().out)
        wrong = [f for f in found['findings'] if f['is_wrong']]
        assert code == (1 if wrong else 0)
        return found, wrong

    yield check
    for robot in robots:
        robot.close()


def without(*topics):
    return lambda topic, msg: [] if topic in topics else [msg]


def test_nothing_is_wrong_with_a_sound_robot(checked):
    found, wrong = checked()
    assert wrong == []
    topics = {t['topic']: t for t in found['topics']}
    assert topics['/scan']['rate_hz'] == pytest.approx(10.0, abs=1.0)
    assert topics['/scan']['reliability'] == ['best_effort']
    assert topics['/scan']['frames'] == ['laser']
    assert topics['/tf']['publishers'] == ['/robot']
    assert -50 < topics['/odom']['age_ms'] < 200


def test_nothing_is_wrong_with_a_robot_in_a_namespace_with_a_clock_of_its_own(checked):
    """As simulators publish them where several robots run: /tf and /clock remapped into it."""
    clock = []

    def late(topic, msg):
        if topic != '/tf_static':
            header = msg.transforms[0].header if topic == '/tf' else msg.header
            header.stamp.sec -= 1_000_000_000
            time_msg = rclpy_class('rosgraph_msgs/msg/Clock')()
            time_msg.clock.sec, time_msg.clock.nanosec = header.stamp.sec, header.stamp.nanosec
            clock[0].publish(time_msg)
        return [msg]

    def add(node):
        clock.append(node.create_publisher(rclpy_class('rosgraph_msgs/msg/Clock'), 'clock', 10))

    found, wrong = checked(add, edit=late, namespace='r1')
    assert wrong == []
    topics = {t['topic']: t for t in found['topics']}
    assert abs(topics['/r1/odom']['age_ms']) < 1000


def test_no_transform_at_all(checked):
    _, wrong = checked(edit=without('/tf', '/tf_static'))
    assert 'no transform on /tf or /tf_static' in wrong[0]['text']
    assert 'static_transform_publisher' in wrong[0]['line']


def test_scans_in_a_frame_that_nobody_places(checked):
    def renamed(topic, msg):
        if topic == '/scan':
            msg.header.frame_id = 'laser_link'
        return [msg]

    _, wrong = checked(edit=renamed)
    assert len(wrong) == 1
    assert "the frame 'laser_link'" in wrong[0]['text']
    assert 'there is laser, is that the same?' in wrong[0]['text']
    assert wrong[0]['line'].endswith('--frame-id base_link --child-frame-id laser_link')


def test_a_clock_that_is_off_by_three_seconds(checked):
    def late(topic, msg):
        if topic == '/scan':
            msg.header.stamp.sec -= 3
        return [msg]

    _, wrong = checked(edit=late)
    assert len(wrong) == 1
    assert wrong[0]['text'].startswith('scan: stamps are 3.')
    assert 'behind the clock' in wrong[0]['text']


def test_node_that_is_started_twice(live, checked):
    from rclpy.node import Node

    for _ in range(2):
        live.add(Node('twin', context=live.context))
    _, wrong = checked()
    assert [f['text'] for f in wrong] == ['2 nodes have the name /twin: is it started twice?']


def test_two_publishers_of_odometry(checked):
    def another(node):
        node.create_publisher(rclpy_class('nav_msgs/msg/Odometry'), 'odom', 10)

    def drifting(topic, msg):
        if topic != '/tf':
            return [msg]
        other = copy.deepcopy(msg)
        other.transforms[0].transform.translation.x += 0.4
        other.transforms[0].header.stamp.nanosec ^= 1
        return [msg, other]

    _, wrong = checked(another, edit=drifting)
    texts = ' '.join(f['text'] for f in wrong)
    assert '/odom has 2 publishers: /robot, /robot' in texts
    assert 'odom to base_link on /tf jumps to and fro' in texts
    assert 'two nodes publish it' in texts


def test_a_listener_that_asks_for_reliable_scans(checked):
    def costmap(node):
        kind = rclpy_class('sensor_msgs/msg/LaserScan')
        node.create_subscription(kind, 'scan', lambda m: None, QoSProfile(depth=5))

    _, wrong = checked(costmap)
    assert [f['text'] for f in wrong] == [
        '/robot asks for reliable /scan, and /robot gives best effort: it hears nothing'
    ]


def test_a_laser_that_hangs_upside_down(checked):
    """Its driver counts its rays as they turn; /tf_static does not say that it hangs."""

    def hanging(topic, msg):
        if topic == '/scan':
            msg.angle_min, msg.angle_max = -msg.angle_min, -msg.angle_max
            msg.angle_increment = -msg.angle_increment
        return [msg]

    _, wrong = checked(edit=hanging)
    assert len(wrong) == 1
    assert 'laser: the laser is mirrored, left is right: it hangs upside down' in wrong[0]['text']
    assert '--roll 3.14159' in wrong[0]['line']


def test_left_and_right_are_swapped(checked):
    """The ranges come in the other order than the angles say."""

    def swapped(topic, msg):
        if topic == '/scan':
            msg.ranges = msg.ranges[::-1]
            msg.intensities = msg.intensities[::-1]
        return [msg]

    _, wrong = checked(edit=swapped)
    assert len(wrong) == 1
    assert 'left is right' in wrong[0]['text']


@pytest.mark.parametrize(
    ('place', 'what'),
    [([-0.2, 0.0, 0.0], 'sign of x'), ([0.2, 0.0, np.pi], 'looks backwards')],
    ids=['x', 'yaw'],
)
def test_a_laser_that_sits_elsewhere(checked, place, what):
    _, wrong = checked(place=np.array(place))
    assert len(wrong) == 1
    assert what in wrong[0]['text']


def test_no_odometry(checked):
    _, wrong = checked(edit=without('/tf', '/odom'))
    assert len(wrong) == 1
    assert 'no odometry: neither odom to base_link on /tf nor odom' in wrong[0]['text']
    assert '-p use_odom:=false' in wrong[0]['line']


def test_scans_on_another_topic(checked):
    def remapped(topic, msg):
        return [] if topic == '/scan' else [msg]

    def front(node):
        node.create_publisher(rclpy_class('sensor_msgs/msg/LaserScan'), 'front/scan', 5)

    _, wrong = checked(front, edit=remapped)
    texts = {f['text']: f['line'] for f in wrong}
    assert texts['scans are on /front/scan, not on /scan'] == '-p scan_topic:=/front/scan'


def test_nothing_runs_at_all(monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(free_domain()))
    assert main(['check', '--seconds', '1']) == 1
    said = capsys.readouterr().out
    assert said.count('WRONG') == 1
    assert 'WRONG: no node is seen in ROS_DOMAIN_ID' in said


def test_topics_of_a_namespace(live, monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    assert main(['check', '--seconds', '1', '--namespace', 'r2', '--json']) == 1
    found = {row['topic'] for row in json.loads(capsys.readouterr().out)['topics']}
    assert {'/r2/scan', '/r2/odom', '/tf'} <= found


def test_nobody_is_there(live, monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    assert main(['check', '--seconds', '1']) == 1
    said = capsys.readouterr().out
    assert 'WRONG: no scan on scan' in said
    assert 'scans are on' not in said
    assert '-p scan_topic:=' in said
