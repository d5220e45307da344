# SPDX-License-Identifier: Apache-2.0
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2 (rclpy)')

from geometry_msgs.msg import Twist  # noqa: E402
from nav_msgs.msg import Odometry as OdometryMsg  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import (  # noqa: E402
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu as ImuMsg  # noqa: E402
from sensor_msgs.msg import LaserScan, PointCloud2  # noqa: E402

from rlml_slam.errors import FileFormatError, InputError, ParameterError  # noqa: E402
from rlml_slam.nodes.simulator import SimulatorNode  # noqa: E402
from rlml_slam.params import Reflector, SimulatorParameters, from_mapping  # noqa: E402
from rlml_slam.ros.codecs import decode  # noqa: E402
from rlml_slam.ros.playback_clock import PlaybackClock  # noqa: E402
from rlml_slam.simulation.robot import SECOND  # noqa: E402
from rlml_slam.simulation.simulation import START, GroundTruth, Simulation  # noqa: E402
from rlml_slam.simulation.world_file import load_world  # noqa: E402
from rlml_slam.types import Detections, Imu, Odometry, Scan  # noqa: E402

# rclpy's message support imports lark, which imports a deprecated module of Python
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")

ROOT = Path(__file__).resolve().parents[2]
DOMAIN = 10 + os.getpid() % 90
BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TYPES = {
    'odom': OdometryMsg,
    'imu': ImuMsg,
    'scan': LaserScan,
    'reflectors': PointCloud2,
    'ground_truth': OdometryMsg,
    '/clock': Clock,
}


@pytest.fixture
def context(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    rclpy.shutdown(context=context)


class Ear:
    """A node that keeps every message of the simulator, in a context of its own spinning."""

    def __init__(self, context, namespace=''):
        self.node = Node('ear', context=context, namespace=namespace)
        self.heard = {topic: [] for topic in TYPES}
        for topic, kind in TYPES.items():
            self.node.create_subscription(kind, topic, self.heard[topic].append, BEST_EFFORT)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)

    def spin_until(self, true, timeout=20.0, also=lambda: None):
        end = time.monotonic() + timeout
        while not true():
            assert time.monotonic() < end, {k: len(v) for k, v in self.heard.items()}
            also()
            self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def ear(context):
    ear = Ear(context)
    yield ear
    ear.close()


class Wall:
    """A wall clock that stands until it is moved."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def make_node(context, wall, **parameters):
    given = {'world': 'room', 'laser.beams': 90, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    return SimulatorNode(wall, context=context, parameter_overrides=overrides)


def ns(msg):
    return decode.stamp(msg, 'test')


def test_the_node_publishes_what_the_simulation_says(context, ear):
    wall = Wall()
    parameters = {'seed': 5, 'duration': 2.0, 'wait_for_subscribers': 1, 'exit_at_end': False}
    node = make_node(context, wall, **parameters)

    def go_on():
        node.tick()
        wall.now += 0.01

    ear.spin_until(lambda: len(ear.heard['reflectors']) == 20, also=go_on)
    expected = Simulation(
        load_world('room'),
        from_mapping({'laser.beams': 90, 'seed': 5, 'duration': 2.0}, SimulatorParameters),
    )
    kinds = {
        Odometry: 'odom', Imu: 'imu', Scan: 'scan', Detections: 'reflectors',
        GroundTruth: 'ground_truth',
    }  # fmt: skip
    want = {topic: [] for topic in kinds.values()}
    for event in expected:
        want[kinds[type(event.message)]].append(event.message)
    ear.spin_until(lambda: all(len(ear.heard[t]) >= len(m) for t, m in want.items()))
    for topic, messages in want.items():
        assert [ns(m) for m in ear.heard[topic]] == [m.stamp for m in messages]
    for msg, true in zip(ear.heard['scan'], want['scan'], strict=True):
        np.testing.assert_array_equal(decode.scan(msg).ranges, true.ranges)
        assert len(msg.intensities) == 90
    for msg, true in zip(ear.heard['reflectors'], want['reflectors'], strict=True):
        read = decode.detections(msg, Reflector())
        np.testing.assert_allclose(read.points, true.points, rtol=1e-5)
    for msg, true in zip(ear.heard['odom'], want['odom'], strict=True):
        np.testing.assert_allclose(decode.odometry(msg).pose, true.pose, atol=1e-9)
        assert (msg.header.frame_id, msg.child_frame_id) == ('odom', 'base_link')
    truth = ear.heard['ground_truth'][-1]
    assert (truth.header.frame_id, truth.child_frame_id) == ('map', 'base_link')
    clocks = [c.clock.sec * SECOND + c.clock.nanosec for c in ear.heard['/clock']]
    assert clocks == sorted(clocks)
    assert clocks[-1] == START + 2 * SECOND
    node.destroy_node()


def test_time_stands_until_the_scan_has_its_subscribers(context):
    wall = Wall()
    node = make_node(context, wall, wait_for_subscribers=1)
    for _ in range(10):
        node.tick()
        wall.now += 1.0
    assert node.simulation.time == START
    node.destroy_node()


def test_time_goes_at_the_rate_of_the_wall_clock(context):
    wall = Wall()
    node = make_node(context, wall, rate=4.0)
    node.tick()
    for k in range(1, 101):
        wall.now = 100.0 + 0.03 * k
        node.tick()
        assert abs(node.simulation.time - START - 0.12 * k * SECOND) <= 10_000_000
    node.destroy_node()


def test_the_node_ends_when_the_drive_is_done(context):
    wall = Wall()
    node = make_node(context, wall, duration=0.1)

    def run():
        for _ in range(1000):
            node.tick()
            wall.now += 0.01

    with pytest.raises(SystemExit) as end:
        run()
    assert end.value.code == 0
    assert node.simulation.done
    node.destroy_node()


def test_the_node_stays_if_asked(context):
    wall = Wall()
    node = make_node(context, wall, duration=0.1, exit_at_end=False)
    for _ in range(200):
        node.tick()
        wall.now += 0.01
    assert node.simulation.done
    node.destroy_node()


def test_cmd_vel_drives_and_nonsense_is_ignored(context, ear):
    wall = Wall()
    node = make_node(context, wall, drive='cmd_vel')
    msg = Twist()
    msg.linear.x, msg.angular.z = 0.3, 0.2
    bad = Twist()
    bad.linear.x = float('nan')
    for _ in range(100):
        node.on_cmd_vel(msg)
        with pytest.raises(InputError, match='not finite'):
            node.on_cmd_vel(bad)  # its listener counts this
        node.tick()
        wall.now += 0.01
    twist = node.simulation.truth(node.simulation.time).twist
    assert twist[0] == pytest.approx(0.3)
    assert twist[2] == pytest.approx(0.2)
    assert 'cmd_vel' in ''.join(s.topic_name for s in node.subscriptions)
    node.destroy_node()


def test_true_reflectors_are_there_for_who_comes_late(context):
    node = make_node(context, Wall())
    got = []
    late = Node('late', context=context)
    late.create_subscription(PointCloud2, 'ground_truth_reflectors', got.append, LATCHED)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(late)
    end = time.monotonic() + 20.0
    while not got:
        assert time.monotonic() < end
        executor.spin_once(timeout_sec=0.05)
    known = decode.detections(got[0], Reflector())
    assert known.frame_id == 'map'
    np.testing.assert_array_equal(known.ids, load_world('room').reflectors.ids)
    executor.shutdown()
    late.destroy_node()
    node.destroy_node()


def test_a_wrong_parameter_refuses_to_start(context):
    with pytest.raises(ParameterError, match=r'^laser\.beams = 0 is outside \[2, 20000\]'):
        make_node(context, Wall(), **{'laser.beams': 0})
    with pytest.raises(FileFormatError, match='no such world'):
        make_node(context, Wall(), world='atlantis')


def test_the_pace_does_not_drift_and_forgives_a_stall():
    pace = PlaybackClock(2.0, now=10.0)
    assert pace.is_due(0.0, 10.0)
    assert not pace.is_due(1.0, 10.499)
    assert pace.is_due(1.0, 10.5)
    assert pace.is_due(1000.0, 510.0)
    assert not pace.is_due(1001.0, 510.499)
    assert pace.stalls == 0
    assert pace.is_due(1002.0, 520.0)  # 9 s late: from here on, time goes from there
    assert pace.stalls == 1
    assert not pace.is_due(1002.1, 520.0)
    assert pace.is_due(1002.1, 520.051)


# the executable


def start(*parameters, remap=()):
    environment = dict(
        os.environ,
        PYTHONPATH=str(ROOT),
        ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
        ROS_DOMAIN_ID=str(DOMAIN),
    )
    options = [word for p in parameters for word in ('-p', p)]
    options += [word for r in remap for word in ('-r', r)]
    return subprocess.Popen(
        [sys.executable, '-m', 'rlml_slam.nodes.simulator', '--ros-args', *options],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_the_executable_publishes_every_message_and_ends_with_zero(context):
    ear = Ear(context, namespace='/robot')
    process = start(
        'world:=room',
        'duration:=4.0',
        'rate:=4.0',
        'wait_for_subscribers:=1',
        remap=['__ns:=/robot'],
    )
    try:
        ear.spin_until(lambda: ear.heard['scan'], timeout=60.0)
        began = time.monotonic()
        ear.spin_until(lambda: process.poll() is not None, timeout=30.0)
        took = time.monotonic() - began
    finally:
        process.kill()
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert 'the drive is done after 4.0 s' in output
    assert [len(m.ranges) for m in ear.heard['scan']] == [1440] * 40
    assert len(ear.heard['reflectors']) == 40
    # the other topics' subscriptions may have been matched a moment after the scan's
    assert 380 <= len(ear.heard['imu']) <= 401
    assert 190 <= len(ear.heard['odom']) <= 201
    # 3.9 s after the first scan at four times the speed, and the lingering at the end
    assert 0.9 < took < 5.0
    ear.close()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_executable_with_zero(context, number):
    ear = Ear(context)
    process = start('world:=room', 'laser.beams:=90', 'repeat:=true')
    try:
        ear.spin_until(lambda: ear.heard['odom'], timeout=60.0)
        process.send_signal(number)
        output = process.communicate(timeout=20.0)[0]
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert 'Traceback' not in output
    ear.close()


def test_a_wrong_world_is_one_line_and_exit_code_one():
    process = start('world:=atlantis')
    output = process.communicate(timeout=60.0)[0]
    assert process.returncode == 1
    assert output.strip().splitlines()[-1].startswith('rlml_slam: atlantis: no such world')
    assert 'Traceback' not in output
