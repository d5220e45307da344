# SPDX-License-Identifier: Apache-2.0
"""What a robot's topics say in a few seconds, taken as the front end takes them; what is wrong."""

from __future__ import annotations

import difflib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.cli.support.mounting import Sighting, distances, pairs_of, wrong_mounting
from rlml_slam.errors import InputError
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_inputs import with_frames_of
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.sensor_input import TF, SensorInput
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.odometry_sources import (
    LEAST_TURN,
    LEAST_WAY,
    MOST_TURN,
    MOST_WAY,
    PoseHistory,
)
from rlml_slam.types import Detections, Imu, Odometry, Scan

MEMORY = 600.0  # [s]
SCANS = 400  # that are remembered
OFF = 0.5  # [s] by which a stamp may differ from the clock of this machine
LEAP = 0.005  # [m] and [rad] from one pose to the next, where every second one is nearer
LASER = '<where the laser is, such as --x 0.2 --z 0.4>'


@dataclass(frozen=True)
class Finding:
    """A sentence, and the line to type; ``is_wrong`` is one that has to be mended."""

    text: str
    line: str = ''
    is_wrong: bool = True


@dataclass
class Heard:
    """What came on a topic: seconds of arrival, age of the stamps then [s], frames."""

    arrivals: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    frames: Counter[str] = field(default_factory=Counter)

    @property
    def rate(self) -> float:
        """Messages per second."""
        a = self.arrivals
        return (len(a) - 1) / (a[-1] - a[0]) if len(a) > 1 and a[-1] > a[0] else 0.0

    @property
    def age(self) -> float:
        """Median age [s], NaN of nothing."""
        return float(np.median(self.ages)) if self.ages else float('nan')


class RobotSetup:
    """Hears messages by stream, ``tf_static`` among them, and finds what is wrong with them."""

    def __init__(self, params: Parameters) -> None:
        self.params = params
        self.heard: defaultdict[str, Heard] = defaultdict(Heard)
        self.tree = Extrinsics()
        self._parents: defaultdict[str, set[str]] = defaultdict(set)
        self._poses: list[Array] = []  # on /tf
        self._kept: list[tuple[str, Any]] = []
        self.scans: list[Scan] = []
        self.places: dict[str, Array] = {}
        self.topic, self.transforms = PoseHistory(MEMORY), PoseHistory(MEMORY)

    def hear(self, stream: str, msg: Any, arrived: float, now: int) -> None:
        """One message that arrived at a time [s], when the clock of the robot was ``now`` [ns]."""
        heard = self.heard[stream]
        heard.arrivals.append(arrived)
        for part in getattr(msg, 'transforms', [msg]):
            stamp = decode.known_stamp(part)  # a finding of its own where there is none
            heard.frames[decode.frame(part.header.frame_id)] += 1
            if stream != 'tf_static' and stamp:
                heard.ages.append(1e-9 * (now - stamp))
            if stream in (TF, 'tf_static'):
                child = decode.frame(part.child_frame_id)
                self._parents[child].add(decode.frame(part.header.frame_id))
                try:
                    self.tree.add(decode.transforms(part))
                except InputError as e:
                    heard.frames[str(e)] += 1
        if stream != 'tf_static':
            self._kept.append((stream, msg))

    # the target of SensorInput

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """Where a sensor sits."""
        self.places[frame_id] = T_base_sensor

    def add_odometry(self, sample: Odometry) -> list[None]:
        """One wheel odometry sample."""
        self.topic.add(sample)
        return []

    def add_transform(self, sample: Odometry) -> list[None]:
        """The pose of base in odom as it is on /tf."""
        self.transforms.add(sample)
        self._poses.append(sample.pose)
        return []

    def add_scan(self, scan: Scan) -> list[None]:
        """One sweep, upright."""
        self.scans.append(scan)
        return []

    def add_detections(self, detections: Detections | Imu) -> list[None]:
        """Not looked at, as the IMU."""
        return []

    add_imu = add_detections

    def findings(self) -> list[Finding]:
        """All that is wrong or worth knowing."""
        asked = self.params.node
        self.params = with_frames_of(self.tree, self.params)
        inputs = InputCounts()
        feed = SensorInput(self.params, self, inputs)
        feed.use_extrinsics(self.tree)
        for stream, msg in self._kept:
            feed.add(stream, msg)
        n = self.params.node
        out = [
            Finding(f'{what} is {is_} here, not {was}', f'-p {what}:={is_}', False)
            for what, is_, was in (
                ('base_frame', n.base_frame, asked.base_frame),
                ('odom_frame', n.odom_frame, asked.odom_frame),
            )
            if is_ != was
        ]
        out += [Finding(f'{s}: {error}') for s, error in inputs.first_errors.items()]
        return [
            *out, *self._missing(), *self._of_frames(), *self._of_clocks(),
            *self._of_transforms(), *self._of_odometry(feed), *self._of_mounting(feed),
        ]  # fmt: skip

    def _missing(self) -> Iterator[Finding]:
        n = self.params.node
        if not self.heard['scan'].arrivals:
            yield Finding(f'no scan on {n.scan_topic}', '-p scan_topic:=<topic>')
        if not self._parents:
            yield Finding(
                'no transform on /tf or /tf_static: nobody says where the laser sits',
                self._static('laser'),
            )
        if self.topic.newest is None and self.transforms.newest is None:
            yield Finding(
                f'no odometry: neither {n.odom_frame} to {n.base_frame} on /tf nor {n.odom_topic}',
                '-p use_odom:=false -p provide_odom_frame:=true, if the robot has none',
            )

    def _static(self, sensor: str) -> str:
        base = self.params.node.base_frame
        return (
            f'ros2 run tf2_ros static_transform_publisher {LASER} --frame-id {base} '
            f'--child-frame-id {sensor}'
        )

    def _of_frames(self) -> Iterator[Finding]:
        base = self.params.node.base_frame
        for sensor in self.heard['scan'].frames:
            if not self._parents or sensor == base or self.tree.path(base, sensor) is not None:
                continue
            known = set(self.tree.frames()) - {base}
            near = difflib.get_close_matches(sensor, known, n=1)
            hint = f'; there is {near[0]}, is that the same?' if near else ''
            text = f'scans are in the frame {sensor!r}, and no transform leads from {base} to it'
            yield Finding(text + hint, self._static(sensor))

    def _of_clocks(self) -> Iterator[Finding]:
        for stream, heard in sorted(self.heard.items()):
            if stream == 'tf_static' or not heard.ages or abs(heard.age) <= OFF:
                continue
            how = 'behind' if heard.age > 0.0 else 'ahead'
            yield Finding(
                f'{stream}: stamps are {abs(heard.age):.1f} s {how} the clock of this machine: '
                'the clocks differ, or the driver is slow',
                'chronyc tracking, on both machines; or -p use_sim_time:=true with a bag',
            )

    def _of_transforms(self) -> Iterator[Finding]:
        n = self.params.node
        if len(self._poses) > 20:
            poses = np.array(self._poses)
            one, two = (np.mean(np.abs(poses[k:] - poses[:-k]).sum(axis=1)) for k in (1, 2))
            if one > LEAP and two < 0.7 * one:  # of one publisher it is twice as far
                yield Finding(
                    f'{n.odom_frame} to {n.base_frame} on /tf jumps to and fro by {one:.2f}: '
                    'two nodes publish it',
                    'ros2 topic info /tf --verbose; stop one, such as publish_tf: false of '
                    'robot_localization or enable_odom_tf: false of the driver',
                )
        if n.map_frame in self._parents[n.odom_frame]:
            yield Finding(
                f'{n.map_frame} to {n.odom_frame} is on /tf: a localization runs',
                'start no other one, or with -p shadow:=true', False,
            )  # fmt: skip
        for child, several in self._parents.items():
            if len(several) > 1:
                yield Finding(f'{child} has several parents: {", ".join(sorted(several))}')

    def _of_odometry(self, feed: SensorInput[None]) -> Iterator[Finding]:
        yield from map(Finding, feed.odometry_problems())
        if self.topic.newest is None or self.transforms.newest is None:
            return
        start = max(h.first for h in (self.topic, self.transforms))
        end = min(self.topic.newest, self.transforms.newest)
        ends = [(h.at(start), h.at(end)) for h in (self.topic, self.transforms)]
        steps = [se2.between(a, b) for a, b in ends if a is not None and b is not None]
        if len(steps) < 2:
            return
        way, turn = np.hypot(*(steps[0] - steps[1])[:2]), abs(se2.wrap(steps[0] - steps[1])[2])
        if way > LEAST_WAY + MOST_WAY * np.hypot(
            *steps[1][:2]
        ) or turn > LEAST_TURN + MOST_TURN * abs(steps[1][2]):
            yield Finding(
                f'the topic {self.params.node.odom_topic} and /tf differ by {way:.2f} m and '
                f'{np.degrees(turn):.1f} degrees in {1e-9 * (end - start):.0f} s; /tf is used',
                '-p odom_source:=tf, or topic', False,
            )  # fmt: skip

    def _of_mounting(self, feed: SensorInput[None]) -> Iterator[Finding]:
        """Of each laser, whether what it sees stays where it is while the robot turns."""
        history = self.topic if self.transforms.newest is None else self.transforms
        for sensor in sorted({s.frame_id for s in self.scans}):
            place = self.places.get(sensor, np.array(self.params.node.laser_pose))
            mine = [s for s in self.scans if s.frame_id == sensor]
            seen: list[Sighting] = []
            for scan in mine[:: max(1, len(mine) // SCANS)]:
                pose = history.at(scan.stamp)
                if pose is not None:
                    seen.append((replace(scan, time_increment=0.0), pose))
            pairs = pairs_of(seen)
            if not pairs:
                yield Finding(
                    f'{sensor}: the robot did not turn, so its mounting is not checked',
                    'turn it by some 90 degrees while this runs', False,
                )  # fmt: skip
                continue
            wrong = wrong_mounting(distances(pairs, place))
            if wrong:
                line = self._static(sensor)
                if 'mirrored' in wrong:
                    rolled = '--roll 0' if feed.hangs(sensor) else '--roll 3.14159'
                    line = line.replace(LASER, f'{LASER} {rolled}')
                yield Finding(f'{sensor}: the laser {wrong}', line)
