# SPDX-License-Identifier: Apache-2.0
"""The executables as processes over DDS: start, work, stop, and what a user's mistake gives."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest
from live import LATCHED, ROOM, ROOT
from rclpy.qos import QoSProfile

from rlml_slam import se2
from rlml_slam.errors import BagError
from rlml_slam.nodes.bag_player import BagPlayerNode
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode

DEEP = QoSProfile(depth=2000)
SECOND = 1_000_000_000
PLAY = ('-p', 'rate:=10.0', '-p', 'clock_rate:=10.0', '-p', 'wait_for_subscribers:=1')
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
SCAN = 'sensor_msgs/msg/LaserScan'


def ended(process):
    code, out = process.finish()
    assert 'Traceback' not in out, out
    return code, out


def test_bag_player_publishes_all_of_a_bag_with_a_clock_and_ends(live, start):
    with BagReader(ROOM) as bag:
        want = {t.name: t.count for t in bag.topics.values()}
        kinds = {t.name: t.msgtype for t in bag.topics.values()}
        last = bag.end
    topics = ['/scan', '/reflectors', '/clock']
    for topic in topics:
        live.listen(topic, kinds.get(topic, 'rosgraph_msgs/msg/Clock'), DEEP)
    live.listen('/ground_truth_reflectors', kinds['/ground_truth_reflectors'], LATCHED)
    player = start('bag_player', '--ros-args', '-p', f'bag:={ROOM}', *PLAY)
    live.spin_until(lambda: len(live.heard['/scan']) == want['/scan'], timeout=60.0)
    live.drain()
    assert ended(player)[0] == 0
    for topic in topics[:-1]:
        assert len(live.heard[topic]) == want[topic], topic
    assert len(live.heard['/ground_truth_reflectors']) == 1
    ticks = [m.clock.sec * SECOND + m.clock.nanosec for m in live.heard['/clock']]
    assert ticks == sorted(ticks)
    # the clock goes on to the end, at 10 Hz
    assert last - ticks[-1] < SECOND // 5
    assert set(np.diff(ticks)) == {SECOND // 10}


def test_bag_player_counts_the_subscribers_of_one_topic(live):
    """Two that hear the truth alone are no reason to begin: the front end may not be there yet."""
    wait = {'wait_for_subscribers': 2, 'wait_for_topic': '/scan', 'start_delay': 0.0}
    player = live.start(BagPlayerNode, bag=str(ROOM), **wait)
    with player.bag:
        for topic, kind in (('/ground_truth', 'nav_msgs/msg/Odometry'), ('/scan', SCAN)):
            assert player.published == 0
            for _ in range(2):
                live.listen(topic, kind)
            live.spin_until(lambda topic=topic: player.playback.listeners(topic) == 2)
            player.tick()
        assert player.published > 0
        with pytest.raises(BagError, match='no topic /nothing of an installed type'):
            player.playback.listeners('/nothing')


def test_processes_map_a_recording_and_stop_cleanly(live, start):
    """Front end, back end and player over DDS; the reflectors hold the robot to the truth."""
    live.listen('pose', POSE, DEEP)
    live.listen('map', 'nav_msgs/msg/OccupancyGrid', LATCHED)
    live.listen('/ground_truth', 'nav_msgs/msg/Odometry', DEEP)
    live.listen('/scan', 'sensor_msgs/msg/LaserScan')
    nodes = [
        start(name, '--ros-args', '-p', 'laser_pose:=[0.2, 0.0, 0.0]', '-p', 'use_sim_time:=true')
        for name in ('front_end', 'back_end')
    ]
    live.spin_until(
        lambda: live.ear.count_publishers('pose') == 1 and live.ear.count_publishers('map') == 1,
        timeout=60.0,
    )
    player = start(
        'bag_player', '--ros-args', '-p', f'bag:={ROOM}', '-p', 'rate:=4.0',
        # of the scans: the front end and this one, so that the beginning is not missed
        '-p', 'wait_for_subscribers:=2', '-p', 'start_delay:=0.5',
    )  # fmt: skip
    live.spin_until(lambda: len(live.heard['pose']) > 250 and live.heard['map'], timeout=60.0)
    assert ended(player)[0] == 0
    for node in nodes:
        node.interrupt()
    for node in nodes:
        code, out = ended(node)
        assert code == 0, out
    truth = [decode.pose_estimate(m) for m in live.heard['/ground_truth']]
    stamps = np.array([t.stamp for t in truth])
    got = decode.pose_estimate(live.heard['pose'][250])
    k = int(np.argmin(np.abs(stamps - got.stamp)))
    assert abs(stamps[k] - got.stamp) < SECOND // 10
    error = se2.between(truth[k].pose, got.pose)
    # the truth may be half its period, 0.05 s, away: 0.03 m at 0.6 m/s
    assert np.hypot(*error[:2]) < 0.06


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGHUP])  # a terminal that closes
def test_both_in_one_process_stop_cleanly(live, start, number):
    live.listen('pose', POSE)
    both = start('slam')
    live.spin_until(lambda: live.ear.count_publishers('rlml/frames') == 1, timeout=60.0)
    live.spin_until(lambda: live.ear.count_publishers('graph') == 1, timeout=60.0)
    # frames pass from one to the other as they are
    assert live.ear.count_subscribers('rlml/frames') == 0
    both.interrupt(number)
    assert ended(both)[0] == 0


INTERRUPTED = """
import os, signal, sys, threading
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.run import run

class Node(ManagedNode):
    def build(self):
        end = threading.Event()
        threading.Thread(target=end.wait).start()
        os.kill(os.getpid(), signal.SIGINT)
        self.exits.callback(end.set)

sys.exit(run(lambda: Node('interrupted')))
"""


def test_signal_while_a_node_is_made_leaves_no_thread_behind():
    words = [sys.executable, '-c', INTERRUPTED]
    done = subprocess.run(words, cwd=ROOT, timeout=60.0, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.parametrize('node', ['front_end', 'back_end', 'slam', 'simulator', 'bag_player'])
def test_wrong_parameter_is_one_line_and_exit_code_1(start, node):
    name, value = {
        'simulator': ('rate', '-1.0'), 'bag_player': ('rate', '-1.0')
    }.get(node, ('mode', 'mopping'))  # fmt: skip
    code, out = ended(start(node, '--ros-args', '-p', f'{name}:={value}'))
    assert code == 1
    lines = [line for line in out.splitlines() if line]
    assert len(lines) == 1, out
    assert f': {name} = ' in lines[0]


@pytest.mark.parametrize(
    ('args', 'message'),
    [
        ([], 'no bag given'),
        (['-p', 'bag:=absent'], 'absent: no such bag'),
        (['-p', f'bag:={ROOT}/setup.py'], 'not a readable bag'),
        (['--params-file', 'absent.yaml'], 'absent.yaml'),
        (['-r', 'broken'], 'broken'),
    ],
)
def test_user_mistake_of_the_player_is_told_without_a_traceback(start, args, message):
    code, out = ended(start('bag_player', '--ros-args', *args))
    assert code == 1
    assert message in out


@pytest.mark.parametrize(
    ('words', 'code', 'said'),
    [
        (['--help'], 0, 'usage: front_end'),
        (['--verbose'], 2, "what is '--verbose'?"),
        (['-p', 'mode=mapping'], 2, '-p mode=mapping: a parameter is given as NAME:=VALUE'),
        (['-p', 'laser_pose:=[0.2, 0, 0]'], 1, 'write all numbers alike'),
        (['-r', 'odom:=/imu'], 1, '/imu cannot be heard as Imu'),
    ],
)
def test_words_after_ros_args_are_answered_without_a_traceback(start, words, code, said):
    found, out = ended(start('front_end', '--ros-args', *words))
    assert (found, said in out) == (code, True), out
    assert 'Traceback' not in out


def test_parameter_file_of_other_nodes_is_named(start, tmp_path):
    """ROS reads it, and nobody uses what is in it."""
    file = tmp_path / 'my.yaml'
    file.write_text('slam:\n  ros__parameters:\n    use_imu: false\n', encoding='utf-8')
    words = ['--params-file', str(file), '-p', 'mode:=localization', '-p', 'map_file_name:=absent']
    _, out = ended(start('back_end', '--ros-args', *words))
    assert 'my.yaml: no section for front_end or back_end or /**: this file has no effect' in out


def test_missing_map_refuses_to_localize(start, tmp_path):
    args = ['-p', 'mode:=localization', '-p', f'map_directory:={tmp_path}']
    code, out = ended(start('back_end', '--ros-args', *args))
    assert code == 1
    assert 'there is no map.rlml and no map.csv' in out
