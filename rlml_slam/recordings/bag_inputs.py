# SPDX-License-Identifier: Apache-2.0
"""A bag as the inputs of the system: chosen topics, the sensors' places, the ground truth."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import BagError, InputError
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.params import Parameters
from rlml_slam.recordings.products import sources
from rlml_slam.ros.bags.bag import TRUTH, BagReader, choose_topics
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.sensor_input import TF, placement_problems, topics_of
from rlml_slam.ros.systems.simulator_messages import TRUE_REFLECTORS
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.ros.tf_odometry import TfOdometry
from rlml_slam.se2 import Array

_TF_SAMPLE = 500  # messages of /tf that are searched for a sensor that /tf_static does not place


class BagInputs:
    """Iterate for (log time [ns], stream of ros/sensor_input.py, message) in log order.

    ``topics`` by stream, as ``params`` ask for them, and ``more_scans`` those of further lidars;
    ``tf`` is the topic of transforms, '' without one; ``extrinsics`` knows the static transforms
    of the whole bag, and those on /tf as far as they are needed. ``params`` have the frames that
    the bag has, where it has others; ``problems`` say what is wrong with the places of lasers.
    """

    def __init__(self, bag: BagReader, params: Parameters) -> None:
        self._bag = bag
        self.tf = self._transforms('tf')
        self.extrinsics = Extrinsics()
        for most in (_TF_SAMPLE, None):  # odometry on /tf may begin late
            self._read_tf(most)
            self.params = with_frames_of(self.extrinsics, params)
            is_on_tf = bool(self._odometry().path)
            if is_on_tf or not self.tf:
                break
        n = self.params.node
        self.has_odometry_on_tf = is_on_tf and n.use_odom and n.odom_source != 'topic'
        without = ('imu', 'odom') if self.has_odometry_on_tf else ('imu',)
        self.topics = choose_topics(bag.topics, n, without)
        self.more_scans = [self._scans(t) for t in topics_of(n, 'scan')[1:]]
        self._lidars = self._frames_of_scans()
        if is_on_tf and self.unplaced():  # else all of /tf has been read
            self._read_tf(None)
        self.problems = placement_problems(n, self.unplaced(), self._lidars)

    def __iter__(self) -> Iterator[tuple[int, str, Any]]:
        stream_of = {topic: stream for stream, topic in self.topics.items()}
        stream_of |= dict.fromkeys(self.more_scans, 'scan')
        if self.has_odometry_on_tf:
            stream_of[self.tf] = TF
        for time, topic, message in self._bag.messages(stream_of):
            yield time, stream_of[topic], message

    def shown(self) -> list[str]:
        """The topics that a viewer needs beside the estimates, without moving transforms."""
        named = (_named(self._bag, TRUTH), _named(self._bag, TRUE_REFLECTORS))
        others = filter(None, (self._transforms('tf_static'), *named))
        return [*self.topics.values(), *self.more_scans, *others]

    def sources(self) -> dict[str, str]:
        """Where each counted stream comes from, in words."""
        n, out = self.params.node, sources(self.topics, self.more_scans)
        if self.has_odometry_on_tf:
            other = f'; compared with {out["odom"]}' if 'odom' in out else ''
            out['odom'] = f'{self.tf}, {n.odom_frame} to {n.base_frame}{other}'
        if unplaced := self.unplaced():
            why = f'no transform from {n.base_frame} to {", ".join(map(repr, unplaced))}'
            out['scan'] += f'; {why}: laser_pose is used: {list(n.laser_pose)}'
        return out

    def unplaced(self) -> list[str]:
        """Frames of scans of which no transform says where they sit on the robot."""
        base, tree = decode.frame(self.params.node.base_frame), self.extrinsics
        lidars = sorted(set(self._lidars.values()))
        return [f for f in lidars if f != base and tree.up(base, f) is None]

    def _frames_of_scans(self) -> dict[str, str]:
        """The frame of the first scan of each topic."""
        scans = filter(None, (self.topics.get('scan'), *self.more_scans))
        return {
            topic: decode.frame(message.header.frame_id)
            for topic in scans
            for message in self._all(topic, 1)
        }

    def _transforms(self, name: str) -> str:
        """The topic of transforms of that name, or the only one in a namespace; '' if none."""
        fitting = [
            t.name for t in self._bag.topics.values()
            if t.name.rsplit('/')[-1] == name and t.msgtype.lower().endswith('tfmessage')
        ]  # fmt: skip
        if f'/{name}' in fitting:
            return f'/{name}'
        return fitting[0] if len(fitting) == 1 else ''

    def _scans(self, name: str) -> str:
        topic = _named(self._bag, name.strip('/'))
        if topic is None:
            raise BagError(f'{self._bag.path}: no topic {name!r}, which scan_topics names')
        return topic

    def _all(self, topic: str | None, most: int | None = None) -> Iterator[Any]:
        """The messages of a topic as far as they can be read, ``most`` at most."""
        if topic is None or topic not in self._bag.topics:
            return
        try:
            for _, _, message in itertools.islice(self._bag.messages([topic]), most):
                yield message
        except BagError:
            return  # reading the inputs meets the damage again and reports it

    def _odometry(self) -> TfOdometry:
        n = self.params.node
        frames = (n.odom_frame, n.base_frame, n.map_frame)
        return TfOdometry(self.extrinsics, *map(decode.frame, frames))

    def _read_tf(self, most: int | None) -> None:
        """Static transforms wherever they are in the bag, and those that /tf begins with."""
        known: set[str] = set()
        for topic, count in ((self.tf, most), (self._transforms('tf_static'), None)):
            for message in self._all(topic, count):
                for transform in message.transforms:  # each by itself, as live
                    if topic == self.tf and transform.child_frame_id in known:
                        continue
                    known.add(transform.child_frame_id)
                    with contextlib.suppress(InputError):
                        self.extrinsics.add(decode.transforms(transform, topic))

    def truth(self) -> Truth | None:
        """The ground truth of the bag, None without any. What cannot be believed is left out."""
        topic = _named(self._bag, TRUTH)
        rows: dict[int, Array] = {}
        frame = ''
        for message in self._all(topic):
            with contextlib.suppress(InputError):
                rows[decode.stamp(message, TRUTH)] = _true_pose(message)
                frame = decode.frame(message.header.frame_id)
        if not rows:
            return None
        stamps = np.array(sorted(rows), dtype=np.int64)
        path = Trajectory(stamps, np.array([rows[t] for t in sorted(rows)]))
        is_map = frame == self.params.node.map_frame
        for message in self._all(_named(self._bag, TRUE_REFLECTORS)):
            with contextlib.suppress(InputError):
                known = decode.detections(message, self.params.reflector, TRUE_REFLECTORS)
                if known.frame_id == frame:
                    return Truth(path, is_map, known.ids, known.points)
        return Truth(path, is_map)


def _named(bag: BagReader, name: str) -> str | None:
    """The topic of that name, in a namespace or not."""
    fitting = [t for t in sorted(bag.topics) if t.strip('/') == name or t.endswith(f'/{name}')]
    return fitting[0] if fitting else None


def _true_pose(message: Any) -> Array:
    """Pose (3,) of an Odometry, PoseStamped, PoseWithCovarianceStamped or PointStamped."""
    if hasattr(message, 'point'):
        return np.array([message.point.x, message.point.y, np.nan])
    if not hasattr(message, 'pose'):
        raise InputError(f'{TRUTH}: a message of this type has no pose')
    return decode.planar_pose(getattr(message.pose, 'pose', message.pose), f'{TRUTH}: pose')


def with_frames_of(tree: Extrinsics, params: Parameters) -> Parameters:
    """The parameters with the frames of the base and of odometry that a recording has.

    Where a name is not in its transforms, the only frame of that name in a namespace is taken;
    for the base also the only one that sits in odom, for odom the only one above the base that
    has the word in its name.
    """
    n = params.node
    known = {*tree.frames(), *filter(None, map(tree.parent, tree.frames()))}
    odom = _found(known, decode.frame(n.odom_frame))
    below = [f for f in tree.frames() if odom and tree.parent(f) == odom]
    base = _found(known, decode.frame(n.base_frame)) or (below[0] if len(below) == 1 else '')
    above = [f for f in known if 'odom' in f.lower() and base and tree.path(f, base)]
    odom = odom or (above[0] if len(above) == 1 else '')
    return replace(
        params, node=replace(n, odom_frame=odom or n.odom_frame, base_frame=base or n.base_frame)
    )


def _found(known: Collection[str], name: str) -> str:
    """The frame of that name, or the only one in a namespace; '' if there is none."""
    if name in known:
        return name
    fitting = [f for f in known if f.endswith(f'/{name}')]
    return fitting[0] if len(fitting) == 1 else ''
