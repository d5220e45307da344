# SPDX-License-Identifier: Apache-2.0
"""Health in time: with every scan, at once on a change, and a gate that stops the robot."""

from __future__ import annotations

import runpy
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from live import LATCHED, room
from std_msgs.msg import String

from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.deformable_slam import DeformableSlamNode
from rlml_slam.nodes.ekf_slam import EkfSlamNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros import diagnostics
from rlml_slam.ros.front_end import frame_publisher
from rlml_slam.types import Health, Level

GATE = Path(__file__).resolve().parents[2] / 'docs' / 'examples' / 'cmd_vel_gate.py'
HEALTH = '/front_end/health'


def level(msg):
    return msg.level[0] if isinstance(msg.level, bytes) else msg.level


def has_stamp(live, wanted):
    return any(v.value == wanted for m in live.heard[HEALTH] for v in m.values)


@pytest.fixture
def node(live):
    node = live.start(FrontEndNode)
    node.sensors.stop_waiting()
    live.listen(HEALTH, 'diagnostic_msgs/msg/DiagnosticStatus', LATCHED)
    live.spin_until(lambda: live.heard[HEALTH])
    return node


def test_health_is_there_before_the_first_scan(live, node):
    assert level(live.heard[HEALTH][0]) == Level.DEGRADED
    assert live.heard[HEALTH][0].message == 'no input yet'


def test_input_that_is_refused_is_named_where_there_is_no_other(live, node):
    for _, msg in room(['/scan'], seconds=1.0):
        msg.angle_increment = 0.0
        node.sensors.add('scan', msg)
    assert node.last is None
    first, why = node.health.health().reasons
    assert first == 'no input yet'
    assert why.startswith('not used: ')
    assert 'scan' in why


def test_each_scan_has_its_health_at_once(live, node):
    poses = 0
    for stream, msg in room(('/scan', '/odom'), seconds=3.0):
        before = node.last
        node.sensors.add(stream, msg)
        if node.last is not before:
            poses += 1
            wanted = f'{node.last.stamp // 10**9}.{node.last.stamp % 10**9:09d}'
            live.spin_until(partial(has_stamp, live, wanted), timeout=2.0)
    assert poses > 20


def test_problems_are_part_of_the_first_health(live, node):
    """They had come with the figures, up to a second later."""
    for stream, msg in room(('/scan', '/odom'), seconds=3.0):
        node.sensors.add(stream, msg)
        if node.last is not None:
            break
    node.health._problems = lambda: ('not yet in the map',)
    node.health.update(node.last)
    live.spin_until(lambda: 'not yet in the map' in live.heard[HEALTH][-1].message, timeout=0.5)
    assert level(live.heard[HEALTH][-1]) == Level.DEGRADED


def test_back_end_in_another_process_says_that_poses_are_not_in_its_map(live, node):
    text = String(data='not yet in the saved map: it is searched')
    publisher = live.ear.create_publisher(String, 'rlml/map_entry', LATCHED)
    publisher.publish(text)
    live.spin_until(lambda: text.data in node.problems())
    publisher.publish(String())
    live.spin_until(lambda: not any('saved map' in problem for problem in node.problems()))


def test_level_is_logged_where_it_changes(live, node):
    live.listen('/rosout', 'rcl_interfaces/msg/Log', 100)
    live.spin_until(lambda: live.ear.count_publishers('/rosout') > 1)
    frame = SimpleNamespace(stamp=1, statuses=np.zeros(0, int), wall_ms=1.0)
    for health in (Health(), Health(), Health(Level.LOST, ('nothing fits', 'slow'))):
        frame.health = health
        node.health.update(frame)
        node.health._problems = tuple
        node.health.publish()
    live.spin_until(lambda: [m.msg for m in live.heard['/rosout'] if 'health' in m.msg][1:])
    said = [(m.level, m.msg) for m in live.heard['/rosout'] if 'health' in m.msg]
    assert said == [(20, 'health is OK'), (30, 'health is LOST: nothing fits')]


def test_another_publisher_of_the_pose_is_a_problem(live, node, monkeypatch):
    """Most likely the node was started twice; one that was killed is forgotten by DDS first."""
    live.ear.create_publisher(PoseWithCovarianceStamped, 'pose', 10)
    live.spin_until(lambda: node.publishers_of('/pose') == ['/ear', '/front_end'])
    assert node.answers.problems() == ()
    monkeypatch.setattr(frame_publisher, 'FORGOTTEN', 0.0)
    assert node.answers.problems() == (
        '/pose has 2 publishers, was it started twice: /ear, /front_end',
    )
    node.health.publish()
    live.spin_until(lambda: '/pose has 2' in live.heard[HEALTH][-1].message)


def test_silence_is_said_without_waiting_for_diagnostics(live, node, monkeypatch):
    for stream, msg in room(('/scan', '/odom'), seconds=2.0):
        node.sensors.add(stream, msg)
    node.health._problems = tuple
    heard = node.health._heard
    live.heard[HEALTH].clear()
    monkeypatch.setattr(diagnostics.time, 'monotonic', lambda: heard + 1.1)
    node.health.watch()
    monkeypatch.undo()
    live.spin_until(lambda: live.heard[HEALTH])
    assert 'no new scan' in live.heard[HEALTH][-1].message
    assert level(live.heard[HEALTH][-1]) >= Level.DEGRADED


@pytest.mark.parametrize('kind', [FrontEndNode, BackEndNode, EkfSlamNode, DeformableSlamNode])
def test_whoever_asks_an_inactive_node_for_its_health_hears_that_it_is_inactive(live, kind):
    node = live.start(kind)
    node.health._frame = SimpleNamespace(stamp=1, statuses=np.zeros(0, int), health=Health())
    node.health._publish_health()
    node.trigger_deactivate()
    topic = f'/{node.get_name()}/health'
    live.listen(topic, 'diagnostic_msgs/msg/DiagnosticStatus', LATCHED)
    live.spin_until(lambda: live.heard[topic])
    (heard,) = live.heard[topic]
    assert level(heard) == Level.DEGRADED
    assert heard.message.endswith('the node is not active')
    node.health._frame.wall_ms = 1.0
    node.trigger_activate()
    live.spin_until(lambda: 'not active' not in live.heard[topic][-1].message)


def test_gate_stops_the_robot_that_is_lost(live):
    gate = live.start(runpy.run_path(str(GATE))['CmdVelGate'])
    live.listen('cmd_vel', 'geometry_msgs/msg/Twist')
    live.spin_until(lambda: live.heard['cmd_vel'])  # nobody has said that it may drive
    drive = Twist()
    drive.linear.x = 1.0

    def passes(health, speed):
        gate.on_health(DiagnosticStatus(level=bytes([health])))
        gate.on_command(drive)  # a closed gate stops the robot again and again
        live.spin_until(lambda: live.heard['cmd_vel'][-1].linear.x == speed)

    live.spin_until(lambda: live.ear.count_publishers('cmd_vel') == 1)
    passes(Level.OK, 1.0)
    passes(Level.LOST, 0.0)
    passes(Level.DEGRADED, 1.0)
    gate._heard -= 1.0  # the localization has died
    live.heard['cmd_vel'].clear()
    gate.on_command(drive)
    live.spin_until(lambda: live.heard['cmd_vel'])
    assert live.heard['cmd_vel'][0].linear.x == 0.0


def test_gate_warns_of_commands_that_pass_beside_it(live, monkeypatch):
    gate = live.start(runpy.run_path(str(GATE))['CmdVelGate'])
    said = []
    monkeypatch.setattr(
        gate, 'get_logger', lambda: SimpleNamespace(warning=lambda text, **_: said.append(text))
    )
    live.spin_until(lambda: gate.count_publishers('cmd_vel') == 1)
    assert not said
    live.ear.create_publisher(Twist, 'cmd_vel', 10)
    live.spin_until(lambda: said)
    assert 'another node publishes on /cmd_vel' in said[0]


def test_problems_do_not_make_a_lost_robot_better():
    lost = Health(Level.LOST, ('nothing fits',))
    found = diagnostics.with_problems(lost, ('no correction',))
    assert found == Health(Level.LOST, ('nothing fits', 'no correction'))
    assert diagnostics.with_problems(Health(), ('no correction',)).level is Level.DEGRADED
