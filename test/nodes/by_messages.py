# SPDX-License-Identifier: Apache-2.0
"""Scenarios through messages in one process: the nodes' callbacks, without DDS and sleeping."""

from __future__ import annotations

import contextlib
import itertools
from collections import defaultdict, deque
from types import SimpleNamespace

from live import overrides
from nav_msgs.srv import LoadMap
from rclpy.serialization import serialize_message
from scenarios import FIRST_NUMBER, SECOND_NUMBER, Driver, decision
from std_srvs.srv import SetBool, Trigger

from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.back_end import mapper as mapper_module
from rlml_slam.ros.codecs.message_types import make_rclpy
from rlml_slam.ros.codecs.request_message import read_request
from rlml_slam.ros.sensors import LATCHED
from rlml_slam.slam.conversation import LocalizeIn

OTHERS = ('deskewed_points', 'reflectors/associated')  # what the ends say to each other, too


class Bus:
    """Topics between the nodes of this process: bytes, in order, as raw subscriptions get them."""

    def __init__(self):
        self.callbacks = defaultdict(list)
        self.latched = {}
        self.waiting = deque()
        self.sent = []

    def publish(self, topic, msg, qos):
        data = serialize_message(msg)
        self.sent.append((topic, msg))
        if qos is LATCHED:
            self.latched[topic] = data
        self.waiting += [(c, data) for _, c in self.callbacks[topic]]

    def subscribe(self, node, topic, callback):
        self.callbacks[topic].append((node, callback))
        if topic in self.latched:
            self.waiting.append((callback, self.latched[topic]))

    def remove(self, node):
        for topic, callbacks in self.callbacks.items():
            self.callbacks[topic] = [(n, c) for n, c in callbacks if n is not node]
        self.waiting.clear()

    def deliver(self):
        """Whether anything was there."""
        any_came = bool(self.waiting)
        while self.waiting:
            callback, data = self.waiting.popleft()
            callback(data)
        return any_came


class Delivered(contextlib.nullcontext):
    """The queue of a subscription on the bus, which gives each message at once."""

    @staticmethod
    def take_message(*_):
        return None


class OnBus:
    """A node whose talk with the other end goes over the bus."""

    bus = None

    def create_publisher(self, kind, topic, qos, **more):
        if not self._is_talk(topic):
            return super().create_publisher(kind, topic, qos, **more)
        return SimpleNamespace(
            topic_name=topic, publish=lambda msg: self.bus.publish(topic, msg, qos),
            get_subscription_count=lambda: len(self.bus.callbacks[topic]),
            assert_liveliness=lambda: None,
        )  # fmt: skip

    def create_subscription(self, kind, topic, callback, qos, **more):
        if not self._is_talk(topic):
            return super().create_subscription(kind, topic, callback, qos, **more)
        self.bus.subscribe(self, topic, callback)
        return SimpleNamespace(topic_name=topic, handle=Delivered())

    @staticmethod
    def _is_talk(topic):
        return topic.startswith('rlml/') or topic in OTHERS


class ByMessages(Driver):
    """Front end and back end as two nodes of this process; each message is waited for."""

    make = staticmethod(make_rclpy)

    def __init__(self, scenario, folder, live, monkeypatch):
        super().__init__(scenario, folder)
        self._live, self._late = live, deque()
        self._bus = bus = Bus()
        driver = self
        # a second run of the back end, whose clock was set back meanwhile
        seconds = itertools.count(FIRST_NUMBER, SECOND_NUMBER - FIRST_NUMBER)
        clock = SimpleNamespace(time=seconds.__next__, monotonic=mapper_module.time.monotonic)
        monkeypatch.setattr(mapper_module, 'time', clock)

        class FrontEnd(OnBus, FrontEndNode):
            def process(self, observation):
                driver.deliver_late(observation.stamp)
                super().process(observation)
                driver.settle()

            def publish(self, record):
                driver.saw(record)
                super().publish(record)

        class BackEnd(OnBus, BackEndNode):
            pass

        FrontEnd.bus = BackEnd.bus = bus
        self._kinds = FrontEnd, BackEnd

    def _start(self, kind):
        p, node = self.params, self.params.node
        values = {
            'map_directory': node.map_directory, 'journal_period': 0.0, 'mode': node.mode,
            'continue_map': node.continue_map, 'back_end__survey': p.back_end.survey,
        }  # fmt: skip
        return kind(context=self._live.context, parameter_overrides=overrides(**values))

    def begin(self):
        self.start_back_end()
        self._start_front_end()

    def _start_front_end(self):
        self.front = self._start(self._kinds[0])
        self.front.sensors.stop_waiting()
        self.settle()

    def restart_front_end(self):
        self._bus.remove(self.front)
        self.front.destroy_node()
        self._start_front_end()

    def start_back_end(self):
        self.back = self._start(self._kinds[1])
        self.back.mapper.searcher._on_result = self._found
        self.settle()

    def kill_back_end(self):
        self._bus.remove(self.back)
        self.back.mapper._ended = True  # saves nothing
        self.back.destroy_node()
        self.back = None

    def _found(self, number, found):
        if self.scenario.delay == 0.0:
            self.back.mapper._on_search_result(number, found)
        else:
            due = self.front.last.stamp + int(self.scenario.delay * 1e9)
            self._late.append((due, number, found))

    def deliver_late(self, stamp):
        while self._late and stamp >= self._late[0][0]:
            _, number, found = self._late.popleft()
            self.back.mapper._on_search_result(number, found)
        self.settle()

    def settle(self):
        """Deliver all, and all that follows from it."""
        is_busy = True
        while is_busy:
            if self.back is not None:
                mapper = self.back.mapper
                for worker in (mapper.worker, mapper.searcher.worker, mapper.worker):
                    worker.submit(lambda: None).result()
            is_busy = self._bus.deliver()

    def feed(self, stream, message):
        self.front.sensors.add(stream, message)

    def _call(self, service, kind, **fields):
        act, response = self.back.map_services.answers[f'~/{service}'], kind.Response()
        self.back.mapper.worker.submit(lambda: act(kind.Request(**fields), response)).result()
        self.settle()
        return response

    def load(self, name):
        answer = self._call('load_map', LoadMap, map_url=name)
        assert answer.result == LoadMap.Response.RESULT_SUCCESS

    def localize(self, on):
        assert self._call('set_localization_mode', SetBool, data=on).success

    def pause(self, on):
        assert self._call('pause_new_measurements', SetBool, data=on).success

    def reset(self):
        assert self._call('reset', Trigger).success

    def give_pose(self, k, offset):
        self.front.control.start_at(self.pose_message(k, offset))

    def end(self):
        mapper, out = self.back.mapper, self.outcome
        mapper.worker.submit(mapper.back_end.finish).result()
        out.keyframes = len(mapper.back_end.keyframes)
        out.trajectory = mapper.back_end.trajectory()[1]
        current = mapper.current()
        out.reflectors, out.grid = current.reflectors, current.grid
        out.kept = len([*self.folder.glob('*.lost-*')])
        out.decisions = decisions(self._bus.sent)
        mapper._ended = True
        for node in (self.front, self.back):
            node.destroy_node()


def decisions(sent):
    """Names of the decisions in (topic, message)."""
    out = []
    for topic, msg in sent:
        if topic == 'rlml/session_start':
            out.append(decision(read_request(msg)))
        elif topic == 'rlml/localization_map':
            out.append(decision(LocalizeIn(1, msg.fields or None)))
    return out
