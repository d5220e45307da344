# SPDX-License-Identifier: Apache-2.0
"""The simulation: a robot in a world, as time-ordered messages; one seed gives one result."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.params import SimulatorParameters
from rlml_slam.se2 import Array
from rlml_slam.simulation.robot import SECOND, RouteFollower, Track, approach, there_and_back
from rlml_slam.simulation.sensors import GyroSensor, LaserSensor, MarkerSensor, WheelSensor
from rlml_slam.simulation.world import World
from rlml_slam.types import Detections, Imu, Odometry, Scan

# time does not begin at 0, which means "no time yet" in ROS
START = SECOND
STEP = 10_000_000


@dataclass(frozen=True)
class GroundTruth:
    """True pose of base: ``T_world_base`` (3,) in the world, ``T_map_base`` (3,) from its start.

    ``twist`` (3,) = (vx, vy, omega) in base. The map frame is the pose of base at the start.
    """

    stamp: int
    T_world_base: Array
    T_map_base: Array
    twist: Array


Message = Odometry | Imu | Scan | Detections | GroundTruth


@dataclass(frozen=True)
class Event:
    """A message that arrives at ``time`` [ns]; scans arrive after their last ray."""

    time: int
    message: Message


class Simulation:
    """Drives through ``world`` and says what the sensors say, as :class:`Event` in order of time.

    Iterate over it until the drive is done, or call :meth:`step` and read :attr:`done`.
    ``seed`` overrides the parameter of that name.
    """

    def __init__(
        self, world: World, parameters: SimulatorParameters | None = None, seed: int | None = None
    ) -> None:
        p = parameters or SimulatorParameters()
        self.world = world
        self.parameters = p
        self._seed = p.node.seed if seed is None else seed
        self._track = Track(START, world.start, STEP)
        route = there_and_back(world.route) if p.node.repeat else world.route
        self._route = RouteFollower(route, p.node)
        self._slide = self._generator('lateral')
        self._faults = {
            kind: self._generator(f'transport/{kind.__name__}')
            for kind in (Odometry, Imu, Scan, Detections)
        }
        self._wheels = WheelSensor(p.wheels, self._generator)
        self._gyro = GyroSensor(p.gyro, self._generator)
        T_base_laser = np.array(p.node.laser_pose)
        self._laser = LaserSensor(p.laser, T_base_laser, p.node.laser_frame, self._generator)
        self._markers = MarkerSensor(p.markers, world.reflectors, self._generator)
        self._counts = dict.fromkeys((Odometry, Imu, Scan, GroundTruth), 0)
        self._pending: list[tuple[int, int, Message]] = []
        self._pushed = 0
        self._command = (0.0, 0.0)
        self._commanded = -(10**18)
        self._arrived: int | None = None
        self._kidnapped = False
        self._steer()

    def _generator(self, name: str) -> np.random.Generator:
        """A generator that depends on the seed and its name, not on the order of calls."""
        return np.random.default_rng([self._seed, zlib.crc32(name.encode())])

    @property
    def time(self) -> int:
        """Present stamp [ns]."""
        return self._track.stamp

    @property
    def T_world_map(self) -> Array:
        """The map frame (3,): the base at start."""
        return self.world.start

    @property
    def progress(self) -> float:
        """Share of the drive that is done, 0 where it has no end."""
        n = self.parameters.node
        if n.duration > 0.0:
            return min(1.0, (self.time - START) / (n.duration * SECOND))
        if n.drive == 'cmd_vel' or n.repeat or self._route.length == 0.0:
            return 0.0
        return 1.0 - self._route.remaining / self._route.length

    @property
    def done(self) -> bool:
        """Whether the drive has come to its end; messages may still be on their way."""
        n = self.parameters.node
        if n.duration > 0.0 and self.time - START >= n.duration * SECOND:
            return True
        if n.drive == 'cmd_vel' or n.repeat or self._arrived is None:
            return False
        # the last sweep is completed, so that the robot is seen to stand
        return self.time - self._arrived >= n.still_time * SECOND + self._laser.sweep

    def truth(self, stamp: int) -> GroundTruth:
        """The truth at a stamp between the start and now; InputError if long ago (300 s)."""
        T_world_base = self._track.pose_at(stamp)
        T_map_base = se2.between(self.T_world_map, T_world_base)
        return GroundTruth(stamp, T_world_base, T_map_base, self._track.twist_at(stamp))

    def true_reflectors(self) -> tuple[Array, NDArray[np.int64]]:
        """Positions (m, 2) of all reflectors in the map frame, and their ids (m,)."""
        set_ = self.world.reflectors
        return se2.transform(se2.inverse(self.T_world_map), set_.points), set_.ids

    def command(self, speed: float, turn_rate: float) -> None:
        """What cmd_vel says now; it holds for ``command_timeout``."""
        self._command = (speed, turn_rate)
        self._commanded = self.time

    def move_reflectors(self, points: Array) -> None:
        """Put the reflectors to other places (m, 2) of the world, at once."""
        moved = replace(self.world.reflectors, points=points)
        self.world = replace(self.world, reflectors=moved)
        self._markers.reflectors = moved

    def kidnap(self, distance: float) -> None:
        """Carry the robot ``distance`` [m] along its route at once, unseen by odometry and IMU."""
        if self._route.length > 0.0:
            self._track.carry(np.array(self._route.skip(distance)))

    def __iter__(self) -> Iterator[Event]:
        while not self.done:
            yield from self.step()
        yield from self.rest()

    def step(self) -> list[Event]:
        """Go on by 10 ms and return what arrived meanwhile, in order."""
        if not self._pushed:
            self._sense()
        self._track.advance()
        n = self.parameters.node
        if 0.0 < n.kidnap_time * SECOND <= self.time - START and not self._kidnapped:
            self._kidnapped = True
            self.kidnap(n.kidnap_distance)
        self._steer()
        self._sense()
        return self._arrivals(self.time)

    def rest(self) -> list[Event]:
        """What is still on its way when the drive is done, in order."""
        return self._arrivals(None)

    def _arrivals(self, until: int | None) -> list[Event]:
        events = []
        while self._pending and (until is None or self._pending[0][0] <= until):
            time, _, message = heapq.heappop(self._pending)
            events.append(Event(time, message))
        return events

    def _wanted(self) -> tuple[float, float]:
        """Speed and turn rate that the driver wants."""
        n = self.parameters.node
        if n.drive == 'cmd_vel':
            fresh = self.time - self._commanded <= n.command_timeout * SECOND
            return self._command if fresh else (0.0, 0.0)
        if self.time - START < n.still_time * SECOND:
            return 0.0, 0.0
        v, w = self._route.steer(*self._track.pose)
        if v == 0.0 and w == 0.0:
            if n.repeat:
                self._route.restart()
            elif self._arrived is None:
                self._arrived = self.time
        return v, w

    def _steer(self) -> None:
        """Choose the twist of the next step within the limits of the drive."""
        n = self.parameters.node
        dt = STEP / SECOND
        v, w = self._wanted()
        v, w = min(max(v, -n.speed), n.speed), min(max(w, -n.turn_rate), n.turn_rate)
        now_v, _, now_w = self._track.twist
        v = approach(now_v, v, n.acceleration * dt)
        w = approach(now_w, w, n.turn_acceleration * dt)
        # sideways motion of variance (lateral |v|)^2 interval dt per step, unseen by the wheels
        wheels = self.parameters.wheels
        sigma = wheels.lateral_noise * abs(v) * (wheels.noise_interval / dt) ** 0.5
        self._track.set_twist(v, sigma * self._slide.standard_normal(), w)

    def _due(self, kind: type[Message], rate: float, delay: int = 0) -> Iterator[int]:
        """Stamps of the messages of a kind that can be made by now."""
        while True:
            stamp = START + round(self._counts[kind] * SECOND / rate)
            if stamp + delay > self.time:
                return
            self._counts[kind] += 1
            yield stamp

    def _sense(self) -> None:
        p = self.parameters
        for stamp in self._due(GroundTruth, p.node.truth_rate):
            self._push(stamp, self.truth(stamp))
        for stamp in self._due(Odometry, p.wheels.rate):
            self._send(self._wheels.measure(self._track, stamp), stamp)
        for stamp in self._due(Imu, p.gyro.rate):
            self._send(self._gyro.measure(self._track, stamp), stamp)
        for stamp in self._due(Scan, p.laser.rate, self._laser.sweep):
            self._scan(stamp)

    def _scan(self, stamp: int) -> None:
        moment = stamp + self._laser.sweep // 2
        geometry = self.world.geometry((moment - START) / SECOND)
        ready = stamp + self._laser.sweep
        scan = self._laser.measure(self._track, stamp, geometry, moment)
        sent = self._send(scan, ready)
        if self.parameters.markers.enabled:
            seen = self._markers.measure(self._track, self._laser, stamp, geometry, moment)
            # the detector gets the scan with its stamp and its delay
            self._send(replace(seen, stamp=sent[0]), sent[1], keep_stamp=True)

    def _push(self, time: int, message: Message) -> None:
        heapq.heappush(self._pending, (time, self._pushed, message))
        self._pushed += 1

    def _send(
        self, message: Odometry | Imu | Scan | Detections, ready: int, keep_stamp: bool = False
    ) -> tuple[int, int]:
        """Pass a message through the transport's faults; its stamp and time of arrival."""
        n = self.parameters.transport
        rng = self._faults[type(message)]
        jitter, (late, delay, drop) = rng.standard_normal(), rng.random(3)
        if not keep_stamp and n.jitter > 0.0:
            message = replace(message, stamp=message.stamp + round(n.jitter * jitter * SECOND))
        arrival = ready + (round(n.late_delay * delay * SECOND) if late < n.late_share else 0)
        if drop >= n.lost_share:
            self._push(arrival, message)
        return message.stamp, arrival
