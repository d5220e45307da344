# SPDX-License-Identifier: Apache-2.0
"""Scenarios through real processes over DDS: two nodes, and a robot that waits for neither."""

from __future__ import annotations

import time
from functools import partial

from by_messages import decisions
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import LATCHED
from nav_msgs.srv import LoadMap
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from scenarios import EPOCH, SAVED, STEP, Driver
from std_srvs.srv import SetBool, Trigger

from rlml_slam.ros.back_end.searcher import DELAY
from rlml_slam.ros.codecs.frame_messages import read_record
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map
from rlml_slam.ros.sensor_input import STREAMS
from rlml_slam.slam.store import map_file

PACE = 4.0  # seconds of the robot in one of the wall clock
PATIENCE = 60.0  # [s] for a process to come, or for what it has to say
CLOUD = 'sensor_msgs/msg/PointCloud2'
DEEP = QoSProfile(depth=2000)
LOGS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATEST = 50  # frames before its end, after the last event, the robot waits for decisions
SLOWER = 1.0  # [s] of the wall clock between two frames then: a search has its time
# frames that a loaded machine may be behind, before the robot waits for it: more than those that
# the front end holds back while it awaits the transform of a sensor
BEHIND = 20
COMMANDS = {'rlml/session_start': DEEP, 'rlml/localization_map': LATCHED}
TALK = {'front_end': 'rlml/frames', 'back_end': 'rlml/session_start'}
SENSORS = ('scan', 'odom', 'reflectors')


class ByProcesses(Driver):
    """Front end and back end as executables, which a restart ends and starts.

    Services are asked while the robot drives on. It waits for a reset, which is of a moment, and
    for a process to start, and where the machine is too slow for its pace. Near its end it slows
    down while anything is to be decided.
    """

    make = staticmethod(make_rclpy)

    def __init__(self, scenario, folder, live, start, monkeypatch):
        super().__init__(scenario, folder)
        self._live, self._process = live, start
        self._commands, self._asked, self._newest, self._met = [], [], EPOCH - 1, 0
        monkeypatch.setenv(DELAY, str(scenario.delay / PACE))
        self._hear('rlml/frames', DEEP, self._heard)
        for topic, qos in COMMANDS.items():
            self._hear(topic, qos, partial(self._heard_command, topic))
        live.listen('reflector_map_points', CLOUD, LATCHED)
        live.listen('/rosout', 'rcl_interfaces/msg/Log', LOGS)
        self._sensors = {
            s: live.ear.create_publisher(rclpy_class(STREAMS[s][1]), s, qos_profile_sensor_data)
            for s in SENSORS
        }
        self._pose = live.ear.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)

    def _hear(self, topic, qos, use):
        self._live.ear.create_subscription(rclpy_class(CLOUD), topic, use, qos)

    def _heard_command(self, topic, msg, info):
        """A command; two topics come in any order, the stamps of DDS are those of their sender."""
        self._commands.append((info['source_timestamp'], topic, msg))

    def _decisions(self):
        sent = sorted(self._commands, key=lambda command: command[0])
        return decisions([(topic, msg) for _, topic, msg in sent])

    def _heard(self, msg):
        record = read_record(msg).of
        self._newest = record.frame.stamp
        self.saw(record)

    def _start(self, name):
        """Start a node; the second result waits until others have seen it."""
        p, node = self.params, self.params.node
        values = {
            'map_directory': node.map_directory, 'journal_period': 0.0, 'mode': node.mode,
            'continue_map': node.continue_map, 'laser_pose': '[0.0, 0.0, 0.0]',
            'back_end.survey': p.back_end.survey,
        }  # fmt: skip
        words = [w for k, v in values.items() if v != '' for w in ('-p', f'{k}:={v}')]
        before = self._writers(TALK[name])
        process = self._process(name, '--ros-args', *words)
        return process, lambda: self._live.spin_until(
            lambda: self._writers(TALK[name]) - before, PATIENCE, f'no {name}'
        )

    def _writers(self, topic):
        found = self._live.ear.get_publishers_info_by_topic(topic)
        return {tuple(w.endpoint_gid) for w in found}

    def begin(self):
        self.back, back_is_there = self._start('back_end')
        self._start_front_end()
        back_is_there()
        self._begin_to_drive()

    def _start_front_end(self):
        self.front, is_there = self._start('front_end')
        is_there()
        links = [*self._sensors.values(), self._pose]
        self._live.spin_until(
            lambda: all(p.get_subscription_count() for p in links), PATIENCE, 'nobody listens'
        )

    def _begin_to_drive(self):
        """Wait until the front end has heard of the back end."""
        self._met += 1
        self._live.spin_until(lambda: self._num_met() >= self._met, PATIENCE, 'ends do not meet')
        self._spin(0.2)  # the other way round
        self._due = time.monotonic()

    def _num_met(self):
        return sum('mode is ' in m.msg for m in self._live.heard['/rosout'])

    def restart_front_end(self):
        self._settle()
        self.front.interrupt()
        assert self.front.finish()[0] == 0
        self._start_front_end()
        self._begin_to_drive()

    def start_back_end(self):
        self.back, is_there = self._start('back_end')
        is_there()
        self._begin_to_drive()

    def kill_back_end(self):
        self.back.close()

    def feed(self, stream, message):
        self._sensors[stream].publish(message)
        if stream != 'reflectors':
            return
        self._due += STEP / 1e9 / PACE
        self._spin(self._due - time.monotonic())
        due = self.now - BEHIND * STEP
        if self._newest < due:
            self._live.spin_until(lambda: self._newest >= due, PATIENCE, 'no frame')
            self._due = time.monotonic()
        s = self.scenario
        last = max([len(s.poses) - LATEST, *(at for at, _, _ in s.events)])
        if self.now - self.shift >= EPOCH + last * STEP:
            end = time.monotonic() + SLOWER
            while not self._is_decided() and (left := end - time.monotonic()) > 0.0:
                self._live.executor.spin_once(timeout_sec=left)
            self._due = max(self._due, time.monotonic())

    def _is_decided(self):
        return len(self._decisions()) >= len(self.scenario.decisions)

    def _spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._live.executor.spin_once(timeout_sec=left)

    def _settle(self):
        """Wait for the frame of the newest scan."""
        self._live.spin_until(lambda: self._newest >= self.now, PATIENCE, 'no frame')

    def jump_back(self, seconds):
        self._settle()
        super().jump_back(seconds)

    def _ask(self, service, kind, **fields):
        client = self._live.ear.create_client(kind, f'back_end/{service}')
        self._live.spin_until(client.service_is_ready, PATIENCE, f'no {service}')
        self._asked.append(client.call_async(kind.Request(**fields)))
        return self._asked[-1]

    def load(self, name):
        self._ask('load_map', LoadMap, map_url=name)

    def localize(self, on):
        self._ask('set_localization_mode', SetBool, data=on)

    def pause(self, on):
        self._ask('pause_new_measurements', SetBool, data=on)

    def reset(self):
        self._settle()
        self._live.spin_until(self._ask('reset', Trigger).done, PATIENCE, 'no reset')
        self._due = time.monotonic()

    def give_pose(self, k, offset):
        self._pose.publish(self.pose_message(k, offset))

    def end(self):
        out, live, s = self.outcome, self._live, self.scenario
        self._settle()
        if not s.empty:
            answer = live.call(Trigger, 'back_end/save_map', Trigger.Request(), PATIENCE)
            assert answer.success, answer.message
            content = map_file.load(self.folder / f'{SAVED}.rlml')
            out.keyframes = len(map_file.keyframes_of(content))
            out.reflectors = map_file.saved_map(content).reflectors
        for future in self._asked:
            live.spin_until(future.done, PATIENCE, 'a service does not answer')
            answer = future.result()
            assert getattr(answer, 'success', True), answer
            assert getattr(answer, 'result', 0) == LoadMap.Response.RESULT_SUCCESS, answer
        if s.empty:  # it shows the map that it localizes in
            cloud = live.heard['reflector_map_points'][-1]
            out.reflectors = read_reflector_map(cloud, 'reflector_map_points')
        for process in (self.front, self.back):
            process.interrupt()
            code, text = process.finish()
            assert code == 0, text
            assert 'Traceback' not in text, text
        out.kept = len([*self.folder.glob('*.lost-*')])
        out.decisions = self._decisions()
