# SPDX-License-Identifier: Apache-2.0
"""A bag as the inputs of the system: chosen topics, the sensors' places, the ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rlml_slam.errors import BagError, InputError
from rlml_slam.params import Parameters
from rlml_slam.ros import convert
from rlml_slam.ros.bag import BagReader, choose_topics
from rlml_slam.ros.simulated import TRUE_REFLECTORS
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.se2 import Array
from rlml_slam.tools.record import Truth
from rlml_slam.tools.tum import Trajectory
from rlml_slam.types import Detections

TRUTH = 'ground_truth'
_TF_SAMPLE = 500  # messages of /tf that are searched for a sensor that /tf_static does not place


class BagInputs:
    """Iterate for (log time [ns], stream of ros/feed.py, message) in log order.

    ``extrinsics`` knows the static transforms of the whole bag from the beginning. Truth on the
    way is collected for :meth:`truth`; ``refused`` counts what of it cannot be believed.
    """

    def __init__(self, bag: BagReader, params: Parameters) -> None:
        self._bag = bag
        self._p = params
        self.topics = choose_topics(bag.topics, params.node)
        self.extrinsics = Extrinsics()
        self.refused = 0
        self._true: list[tuple[int, Array]] = []
        self._true_frame = ''
        self._true_reflectors: Detections | None = None
        self._truth_topic = _named(bag, TRUTH)
        self._reflectors_topic = _named(bag, TRUE_REFLECTORS)
        self._read_tf()

    def _read_tf(self) -> None:
        """Static transforms wherever they are in the bag, and those that /tf begins with."""
        for topic in ('/tf', '/tf_static'):
            if topic not in self._bag.topics:
                continue
            try:
                for k, (_, _, message) in enumerate(self._bag.messages([topic])):
                    if topic == '/tf' and k >= _TF_SAMPLE:
                        break
                    self._add_transforms(topic, message)
            except BagError:
                pass  # the damage is met again, and told, when the inputs are read

    def _add_transforms(self, topic: str, message: Any) -> None:
        try:
            self.extrinsics.add(convert.transforms(message, topic))
        except InputError:
            self.refused += 1

    def __iter__(self) -> Iterator[tuple[int, str, Any]]:
        stream_of = {topic: stream for stream, topic in self.topics.items()}
        others = [t for t in (self._truth_topic, self._reflectors_topic) if t is not None]
        for time, topic, message in self._bag.messages([*stream_of, *others]):
            if topic in stream_of:
                yield time, stream_of[topic], message
                continue
            try:
                self._add_truth(topic, message)
            except InputError:
                self.refused += 1

    def _add_truth(self, topic: str, message: Any) -> None:
        if topic == self._reflectors_topic:
            self._true_reflectors = convert.detections(message, self._p.reflector, topic)
            return
        pose = _true_pose(message, topic)
        if pose is not None:
            self._true.append((convert.stamp(message, topic), pose))
            self._true_frame = convert.frame(message.header.frame_id)

    def truth(self) -> Truth | None:
        """The ground truth that was met, None without any."""
        rows = sorted(self._true, key=lambda row: row[0])
        if not rows:
            return None
        stamps = np.array([t for t, _ in rows], dtype=np.int64)
        first = np.concatenate([[True], np.diff(stamps) > 0])
        trajectory = Trajectory(stamps[first], np.array([p for _, p in rows])[first])
        is_map = self._true_frame == self._p.node.map_frame
        known = self._true_reflectors
        if known is None or known.frame_id != self._true_frame:
            return Truth(trajectory, is_map)
        return Truth(trajectory, is_map, known.ids, known.points)


def _named(bag: BagReader, name: str) -> str | None:
    """The topic of that name, in a namespace or not."""
    fitting = [t for t in sorted(bag.topics) if t.strip('/') == name or t.endswith(f'/{name}')]
    return fitting[0] if fitting else None


def _true_pose(message: Any, topic: str) -> Array | None:
    """Pose (3,) of an Odometry, PoseStamped, PoseWithCovarianceStamped or PointStamped."""
    if hasattr(message, 'point'):
        return np.array([message.point.x, message.point.y, np.nan])
    pose = getattr(message, 'pose', None)
    if pose is None:
        return None
    return convert.planar_pose(getattr(pose, 'pose', pose), f'{topic}: pose')
