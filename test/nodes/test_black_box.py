# SPDX-License-Identifier: Apache-2.0
"""The black box: when it writes, what is in the file, and what it may not cost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from live import ROOT, room
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from rlml_slam.cli.main import main
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.params import Parameters, from_mapping
from rlml_slam.recordings.incident import recorded_parameters
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.front_end import incident_file
from rlml_slam.ros.front_end.black_box import Triggers
from rlml_slam.ros.front_end.incident import Published, Received
from rlml_slam.types import Frame, Health, Level, Motion, Observation

SECOND = 1_000_000_000
STILL = Motion(np.zeros(3), np.zeros((3, 3)))


def frame(level=Level.OK, jumped=False, stamp=SECOND):
    pose, cov, none = np.zeros(3), np.eye(3), np.zeros(0, np.int64)
    observation = Observation(stamp, STILL)
    health = Health(level, ('the reason',) * bool(level))
    return Frame(stamp, observation, pose, cov, pose, cov, none, none, health, jumped=jumped)


def reasons(frames, patience=5.0):
    triggers = Triggers(patience)
    return [triggers.reason(f, float(k)) for k, f in enumerate(frames)]


def test_lost_is_an_incident_once_and_only_of_a_robot_that_knew_where_it_was():
    ok, lost = frame(), frame(Level.LOST)
    assert reasons([lost, lost]) == ['', '']  # at the start in a saved map
    assert reasons([lost, ok, lost, lost, ok, lost]) == ['', '', 'lost', '', '', 'lost']


def test_degraded_for_long_and_jumps_are_incidents():
    bad = frame(Level.DEGRADED)
    assert reasons([frame(), *[bad] * 9]).count('degraded') == 1
    assert reasons([frame(), *[bad] * 5]).count('degraded') == 0
    assert reasons([frame(), frame(jumped=True)]) == ['', 'jump']
    assert reasons([frame(Level.LOST), frame(jumped=True)]) == ['', '']  # found again
    assert reasons([bad, frame(jumped=True)]) == ['', '']  # found at the start in a saved map
    assert reasons([frame(), bad, frame(jumped=True)]) == ['', '', 'jump']


def publish(live, node, seconds, namespace=''):
    """The sensors of the room over DDS."""
    publishers = {}
    for stream, msg in room(seconds=seconds):
        if stream not in publishers:
            topic = stream if stream.startswith('/') else f'{namespace}/{stream}'
            publishers[stream] = live.ear.create_publisher(type(msg), topic, QoSProfile(depth=100))
            live.spin_until(lambda t=topic: live.ear.count_subscribers(t) == 1)
        publishers[stream].publish(msg)
        live.executor.spin_once(timeout_sec=0.0)
    live.spin_until(lambda: node.last is not None)
    live.drain()


def incidents(folder):
    return sorted((folder / 'maps' / 'incidents').glob('incident-*.mcap'))


@pytest.fixture
def node(live):
    node = live.start(FrontEndNode, incident__after=0.3, laser_pose=[0.2, 0.0, 0.0])
    node.sensors.stop_waiting()
    return node


def test_incident_on_request_holds_inputs_and_outputs_and_can_be_replayed(live, node, tmp_path):
    publish(live, node, 3.0)
    answer = live.call(Trigger, 'front_end/save_incident', Trigger.Request())
    assert answer.success
    assert 'asked.mcap is written in 0.3 s' in answer.message
    live.spin_until(lambda: incidents(tmp_path) != [])
    (path,) = incidents(tmp_path)
    with BagReader(path) as bag:
        counts = {t.name: t.count for t in bag.topics.values()}
        (about,) = [json.loads(m.data) for _, _, m in bag.messages(['/incident'])]
    assert about['map_id'].startswith('none')
    assert about['parameters'] == {'incident.after': 0.3, 'laser_pose': [0.2, 0.0, 0.0]}
    sent = [stream for stream, _ in room(seconds=3.0)]
    for stream in ('scan', 'odom', 'reflectors'):
        assert counts[f'/{stream}'] == sent.count(stream)
    assert counts['/pose'] == counts['/front_end/health'] > 10
    assert main(['replay', str(path), '--out', str(tmp_path / 'out'), '--no-report']) == 0


def test_robot_whose_namespace_is_that_of_the_talk_between_the_ends_is_recorded(live):
    node = live.add(FrontEndNode(context=live.context, namespace='rlml'))
    node.sensors.stop_waiting()
    publish(live, node, 1.0, '/rlml')
    kept = {r.topic for r in node.black_box._received}
    assert kept == {'/rlml/scan', '/rlml/odom', '/rlml/imu', '/rlml/reflectors'}


def test_request_that_writes_nothing_is_refused_with_the_reason(live, node, tmp_path):
    def refusal():
        answer = live.call(Trigger, 'front_end/save_incident', Trigger.Request())
        assert not answer.success
        return answer.message

    node.trigger_deactivate()
    assert refusal() == 'nothing is written: the node is not active'
    node.trigger_cleanup()
    node.set_parameters([Parameter('incident.record', value=False)])
    node.trigger_configure()
    node.trigger_activate()
    assert refusal() == 'nothing is written: incident.record is false'
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert incidents(tmp_path) == []


def test_lost_writes_one_file_within_the_period(live, node, tmp_path):
    for level in (Level.OK, Level.LOST, Level.OK, Level.LOST):
        node.black_box.follow(frame(level))
    live.spin_until(lambda: incidents(tmp_path) != [])
    live.drain()
    (path,) = incidents(tmp_path)
    assert 'lost' in path.name


def test_end_of_the_node_writes_what_is_pending(live, node, tmp_path):
    node.black_box.follow(frame())
    node.black_box.follow(frame(Level.LOST))
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert len(incidents(tmp_path)) == 1


def test_memory_is_bounded(live):
    node = live.start(FrontEndNode, incident__max_memory=1.0)
    kind = type(next(m for stream, m in room(['/odom'])))
    for _ in range(100):
        node.black_box.tap('/odom', kind, bytes(50_000))
    box = node.black_box
    assert sum(len(r.data) for r in box._received) == box._bytes <= 1_000_000


def test_steps_of_the_wall_clock_cost_and_reorder_nothing(live, monkeypatch):
    node = live.start(FrontEndNode)
    kind = type(next(m for stream, m in room(['/odom'])))
    for step in (0, 10**6, -(10**6)):
        monkeypatch.setattr(time, 'time_ns', lambda step=step: 10**18 + step * SECOND)
        node.black_box.tap('/odom', kind, bytes(10))
        node.black_box.follow(frame())
    times = [r.time for r in node.black_box._received]
    assert len(times) == len(node.black_box._published) == 3
    assert times == sorted(times)


def test_file_has_the_order_in_which_messages_are_used(live, node, tmp_path):
    """After a pause of two seconds the queues are emptied one after the other."""
    queued = [(stream, msg) for stream, msg in room(seconds=2.0) if stream != '/tf_static']
    for wanted in ('reflectors', 'imu', 'odom', 'scan'):
        for stream, msg in queued:
            if stream.strip('/') == wanted:
                node.black_box.tap(f'/{wanted}', type(msg), serialize_message(msg))
    topics = [listener.topic_name for _, listener in node.sensors._queues]
    node.black_box.arrange(topics)
    received = list(node.black_box._received)
    stamps = [decode.serialized_stamp(r.data) for r in received]
    assert len(received) == len(queued)
    assert stamps == sorted(stamps)
    times = [r.time for r in received]
    assert times == sorted(times)
    path = tmp_path / 'incident.mcap'
    incident_file.write(path, {}, [], received, [], Parameters())
    with BagReader(path) as bag:
        read = [decode.stamp(m, topic) for _, topic, m in bag.messages() if topic != '/incident']
    assert read == stamps
    node.black_box.tap('/odom', type(queued[0][1]), b'\x00\x01')  # too short for a stamp
    node.black_box.tap('/odom', type(queued[0][1]), b'')
    node.black_box.arrange(topics)
    assert len(node.black_box._received) == len(queued) + 2


def test_replay_begins_as_the_robot_was(tmp_path):
    path = tmp_path / 'incident.mcap'
    start = np.array([3.0, -1.0, 0.5])
    published = [Published(70, 7, start, 0.04 * np.eye(3), Health())]
    given = {'laser_pose': (0.2, 0.0, 0.0), 'map_frame': 'site', 'mode': 'localization'}
    incident_file.write(path, {}, [], [], published, from_mapping(given, Parameters))
    params = recorded_parameters(path)
    assert params.node.laser_pose == (0.2, 0.0, 0.0)
    assert params.node.mode == 'mapping'  # the map is given to the replay
    assert np.allclose(params.node.map_start_pose, start)
    assert np.allclose(params.node.map_start_sigma, 0.2)
    assert recorded_parameters(ROOT / 'bags' / 'room') is None


def test_folder_that_cannot_be_written_is_a_problem_and_no_more(live, node, tmp_path):
    (tmp_path / 'maps').mkdir(exist_ok=True)
    (tmp_path / 'maps' / 'incidents').touch()
    node.black_box.follow(frame())
    node.black_box.follow(frame(Level.LOST))
    live.spin_until(lambda: node.problems() != ())
    assert any('incident not written' in p for p in node.problems())


def test_oldest_files_make_room(tmp_path):
    for k in range(5):
        path = tmp_path / f'incident-{k}.mcap'
        path.write_bytes(bytes(100))
        os.utime(path, (k, k))
    (tmp_path / 'mine.mcap').write_bytes(bytes(1000))
    incident_file.make_room(tmp_path, 250.0)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        'incident-3.mcap', 'incident-4.mcap', 'mine.mcap'
    ]  # fmt: skip
    incident_file.make_room(tmp_path, 1.0)
    assert (tmp_path / 'incident-4.mcap').exists()  # the newest stays


KILLED = """
import sys, time
from pathlib import Path
import numpy as np
from rlml_slam.params import Parameters
from rlml_slam.ros.front_end.incident import Received
from rlml_slam.ros.front_end.incident_file import write
data = [Received(k, '/odom', 'nav_msgs/msg/Odometry', bytes(700)) for k in range(1, 20000)]
print('ready', flush=True)
write(Path(sys.argv[1]), {}, [], data, [], Parameters())
"""


@pytest.mark.parametrize('delay', [0.0, 0.05, 0.1, 0.2, 0.4, 0.8])
def test_kill_while_writing_leaves_a_readable_file_or_none(tmp_path, delay):
    path = tmp_path / 'incident-x.mcap'
    process = subprocess.Popen(
        [sys.executable, '-c', KILLED, str(path)], stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout.readline() == b'ready\n'
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    if path.exists():
        with BagReader(path) as bag:
            assert sum(1 for _ in bag.serialized(['/odom'])) == 19999


def test_latched_messages_begin_the_file_and_unknown_types_are_left_out(tmp_path):
    path = tmp_path / 'incident.mcap'
    static = [Received(5, '/tf_static', 'tf2_msgs/msg/TFMessage', b'\x00\x01\x00\x00' + bytes(4))]
    odd = Received(60, '/odd', 'maker_msgs/msg/Odd', bytes(10))
    published = [Published(70, 7, np.zeros(3), np.eye(3), Health())]
    params = from_mapping({'map_frame': 'site'}, Parameters)
    incident_file.write(path, {'reasons': 'why'}, static, [odd], published, params)
    with BagReader(path) as bag:
        order = [(t, topic) for t, topic, _ in bag.messages()]
        (pose,) = [m for _, _, m in bag.messages(['/pose'])]
    assert order[:2] == [(60, '/incident'), (60, '/tf_static')]
    assert {topic for _, topic in order[2:]} == {'/pose', '/front_end/health'}
    assert pose.header.frame_id == 'site'
