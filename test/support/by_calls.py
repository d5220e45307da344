# SPDX-License-Identifier: Apache-2.0
"""Scenarios through calls: conductor, front end and back end as objects, without any ROS."""

from __future__ import annotations

from types import SimpleNamespace

from scenarios import FIRST_NUMBER, SECOND_NUMBER, Driver, decision

from rlml_slam.errors import InputError
from rlml_slam.maps import survey
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.conversation import LocalizeIn
from rlml_slam.slam.front_end_session import FrontEndSession
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.slam.system import System


class ByCalls(Driver):
    """Drives a Slam; restarted ends are new objects, with numbers of their own."""

    make = staticmethod(make_bag)

    def begin(self):
        s, self._latched, self._session = self.scenario, None, 0
        self._survey = survey.load(self.folder / 'plant.csv') if s.survey else None
        self.slam = slam = Slam(self.params, survey=self._survey, search_delay=s.delay)
        slam.session = FrontEndSession(self.params, self._new_session)
        slam.system = System(self.params, FIRST_NUMBER)
        execute, give = slam.execute, slam._give

        def executed(commands):
            commands = list(commands)
            for command in commands:
                if (name := decision(command)) is not None:
                    self.outcome.decisions.append(name)
                if isinstance(command, LocalizeIn):
                    self._latched = command
            execute(commands)

        def given(record):
            self.saw(record)
            give(record)

        slam.execute, slam._give = executed, given
        self._restart_inputs()
        self._begin_map()

    def _new_session(self):
        self._session += 1
        return self._session

    def _restart_inputs(self):
        self.slam.synchronizer = Synchronizer(self.params)
        self._feed = SensorInput(self.params, self.slam, self.slam.synchronizer.inputs)

    def _begin_map(self):
        slam, node = self.slam, self.params.node
        if node.mode == 'localization':
            self.load(node.map_file_name, localize=True)
            return
        slam.execute(slam.system.make_map())
        if node.continue_map:
            self.load(node.map_file_name)

    def feed(self, stream, message):
        try:
            self._feed.add(stream, message)
        except InputError:  # as the node does
            self._restart_inputs()
            self.slam.session.restart()

    def load(self, name, localize=False):
        content = map_file.load(self.folder / f'{name}.rlml')
        if localize or self.slam.system.map is not None:
            self.slam.use_map(map_file.saved_map(content))
        else:
            self.slam.continue_map(content)

    def localize(self, on):
        self.slam.set_localization_mode(on)

    def pause(self, on):
        self.slam.execute(self.slam.system.pause(on))

    def reset(self):
        self.slam.reset()

    def give_pose(self, k, offset):
        start = decode.start_pose(self.pose_message(k, offset), 'map')
        self.slam.session.start_at(start.stamp, start.pose, start.cov)

    def restart_front_end(self):
        self.slam.session = FrontEndSession(self.params, self._new_session)
        self._restart_inputs()
        if self._latched is not None:
            self.slam._command(self._latched)

    def kill_back_end(self):
        self.slam.system = SimpleNamespace(map=None, on_frame=lambda record: [])

    def start_back_end(self):
        self.slam.system = System(self.params, SECOND_NUMBER)
        self.slam.back_end = BackEnd(self.params, self._survey)
        self._begin_map()

    def end(self):
        slam, out = self.slam, self.outcome
        slam.back_end.finish()
        out.keyframes = len(slam.back_end.keyframes)
        out.trajectory = slam.back_end.trajectory()[1]
        out.reflectors, out.grid = slam.map().reflectors, slam.map().grid
