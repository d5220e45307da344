# SPDX-License-Identifier: Apache-2.0
"""The topics that command a front end: those of users and those of the back end."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks

from rlml_slam.errors import InputError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.correction_message import read_correction
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map
from rlml_slam.ros.codecs.request_message import read_request
from rlml_slam.ros.message_guard import LARGE, SMALL, Listener
from rlml_slam.ros.sensors import ALIVE, LATCHED, LEASE, RELIABLE
from rlml_slam.slam.conversation import FrontEndCommand, LocalizeIn, SessionFrame
from rlml_slam.slam.front_end_session import FrontEndSession
from rlml_slam.types import Reflectors

ABSENT = 2.0  # [s] without a sign of the back end, after which it is reported
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
CLOUD = 'sensor_msgs/msg/PointCloud2'
GRID = 'nav_msgs/msg/OccupancyGrid'
TEXT = 'std_msgs/msg/String'
LONGEST = 500  # characters of a text that is passed on


class FrontEndControl:
    """Converts messages to commands for a FrontEndSession; ``began`` is called at each session.

    ``again`` takes the frame of an observation that begins a session after it was used before.

    Commands of a back end in the same process come by ``command`` from any thread, and are carried
    out in the node's; then there are no topics for them.
    """

    def __init__(
        self,
        node: Any,
        params: Parameters,
        began: Callable[[], None],
        again: Callable[[SessionFrame], None],
        has_back_end: bool,
    ) -> None:
        self._logger = node.get_logger()
        self._map_frame = params.node.map_frame
        self._began = began
        self._again = again
        self.session = FrontEndSession(params, unique_number)
        self._inbox: deque[FrontEndCommand] = deque()
        self._arrival = node.create_guard_condition(self.carry_out)
        self._grids: dict[int, OccupancyGrid | None] = {}
        self._reflectors: dict[int, Reflectors | None] = {}
        # of the readers of one lease in a process, Fast DDS says to the first alone that a writer
        # lives, be it destroyed by now: each has a lease of its own, .1 s longer at most
        alive = copy.copy(ALIVE)
        alive.liveliness_lease_duration = Duration(
            nanoseconds=int(LEASE * 1e9) + time.monotonic_ns() % 100_000_000
        )
        topics: tuple[tuple[str, str, Callable[[Any], None], Any, int], ...] = (
            (CLOUD, 'rlml/graph_correction', self.on_correction, alive, LARGE),
            (CLOUD, 'rlml/session_start', self.on_request, RELIABLE, SMALL),
            (GRID, 'rlml/localization_grid', self.on_grid, LATCHED, LARGE),
            (CLOUD, 'rlml/localization_map', self.on_map, LATCHED, LARGE),
            (TEXT, 'rlml/map_entry', self.on_entry, LATCHED, SMALL),
        )
        self._entry: tuple[str, ...] = ()  # why poses are not in the back end's map
        self._absent: float | None = None if has_back_end else time.monotonic()
        self._listeners: list[Listener] = []
        for kind, topic, use, qos, largest in (
            (POSE, 'initialpose', self.start_at, RELIABLE, SMALL),
            *(() if has_back_end else topics),
        ):
            events = SubscriptionEventCallbacks(liveliness=self._on_liveliness)
            options = {'event_callbacks': events} if qos is alive else {}
            listener = Listener(node, rclpy_class(kind), topic, use, qos, largest, **options)
            self._listeners.append(listener)

    def _on_liveliness(self, event: Any) -> None:
        """A back end has come, or gives no sign any more."""
        self._absent = None if event.alive_count else time.monotonic() - LEASE

    def problems(self) -> tuple[str, ...]:
        """What makes the front end's health DEGRADED besides its estimate."""
        silent = 0.0 if self._absent is None else time.monotonic() - self._absent
        if silent < ABSENT:
            return self._entry
        return (f'no correction for {silent:.1f} s: is back_end running?',)

    def restart(self, misplaced: bool = False) -> None:
        """Begin at ``map_start_pose``: the clock jumped back, or a sensor was ``misplaced``."""
        self.session.restart(misplaced)
        self._began()

    def start_at(self, msg: Any) -> None:
        """Begin at a pose that a user gives; with the stamp of a frame, it is of that moment."""
        start = decode.start_pose(msg, self._map_frame)
        pose = self.session.start_at(start.stamp, start.pose, start.cov)
        self._began()
        self._logger.info(f'begins at {np.round(pose, 3).tolist()}, as given on initialpose')

    def on_entry(self, msg: Any) -> None:
        """Why poses are not in the map that the back end is to continue, '' where they are."""
        self._entry = (msg.data[:LONGEST],) if msg.data else ()

    def on_request(self, msg: Any) -> None:
        """A place where the back end found the robot."""
        self.execute(read_request(msg))

    def on_correction(self, msg: Any) -> None:
        """What the graph knows of a frame."""
        self.execute(read_correction(msg))

    def on_grid(self, msg: Any) -> None:
        """The grid of a map; one without cells is none."""
        topic = 'rlml/localization_grid'
        self._grids = {number_of(msg, topic): decode.occupancy_grid(msg, topic)}
        self._use_map()

    def on_map(self, msg: Any) -> None:
        """The reflectors of a map; without fields, there is none to localize in."""
        topic = 'rlml/localization_map'
        known = read_reflector_map(msg, topic) if msg.fields else None
        self._reflectors = {number_of(msg, topic): known}
        self._use_map()

    def _use_map(self) -> None:
        """Both parts have come, in whatever order: the same number says that they are of one."""
        for number in self._grids.keys() & self._reflectors.keys():
            reflectors, grid = self._reflectors.pop(number), self._grids.pop(number)
            saved = None if reflectors is None else SavedMap(reflectors, grid)
            self.execute(LocalizeIn(number, saved))

    def command(self, command: FrontEndCommand) -> None:
        """A command of the back end in this process, from any thread."""
        self._inbox.append(command)
        self._arrival.trigger()

    def carry_out(self) -> None:
        """Carry out the commands that have come, by topics as well.

        On a machine that is too slow, the executor serves them only after all sensors.
        """
        for listener in self._listeners:
            listener.drain()
        while self._inbox:
            self.execute(self._inbox.popleft())

    def execute(self, command: FrontEndCommand) -> None:
        """Carry out one command."""
        before, mode = self.session.session, self.session.mode
        record = self.session.execute(command)
        if self.session.mode != mode:
            known = self.session.map
            of = '' if known is None else f' in a map of {len(known.reflectors)} reflectors'
            self._logger.info(f'mode is {"mapping" if known is None else "localization"}{of}')
        if self.session.session != before:
            self._began()
        if record is not None:
            self._again(record)


def number_of(msg: Any, topic: str) -> int:
    """Number of a request, which is in the place of the stamp; InputError if there is none."""
    number = decode.stamp(msg, topic)
    if number >= 2**32:  # records have as many bits for it
        raise InputError(f'{topic}: {number} in the place of the stamp is no number of a request')
    return number


def unique_number() -> int:
    """Number of a session, which no other process gives."""
    return time.time_ns() // 1000 % 2**32 or 1
