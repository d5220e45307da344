# SPDX-License-Identifier: Apache-2.0
"""A bag as the inputs of the system: chosen topics, the sensors' places, the ground truth."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import BagError, InputError
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.params import Parameters
from rlml_slam.ros.bags.bag import BagReader, choose_topics
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.sensor_input import topics_of
from rlml_slam.ros.systems.simulator_messages import TRUE_REFLECTORS
from rlml_slam.ros.tf import Extrinsics
from rlml_slam.se2 import Array

TRUTH = 'ground_truth'
_TF_SAMPLE = 500  # messages of /tf that are searched for a sensor that /tf_static does not place


class BagInputs:
    """Iterate for (log time [ns], stream of ros/sensor_input.py, message) in log order.

    ``topics`` by stream, as ``params`` ask for them, and ``more_scans`` those of further lidars;
    ``extrinsics`` knows the static transforms of the whole bag.
    """

    def __init__(self, bag: BagReader, params: Parameters) -> None:
        self._bag = bag
        self.params = params
        self.topics = choose_topics(bag.topics, params.node)
        self.more_scans = [self._scans(t) for t in topics_of(params.node, 'scan')[1:]]
        self.extrinsics = Extrinsics()
        self._read_tf()

    def __iter__(self) -> Iterator[tuple[int, str, Any]]:
        stream_of = {topic: stream for stream, topic in self.topics.items()}
        stream_of |= dict.fromkeys(self.more_scans, 'scan')
        for time, topic, message in self._bag.messages(stream_of):
            yield time, stream_of[topic], message

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

    def _read_tf(self) -> None:
        """Static transforms wherever they are in the bag, and those that /tf begins with."""
        for topic, most in (('/tf', _TF_SAMPLE), ('/tf_static', None)):
            for message in self._all(topic, most):
                for transform in message.transforms:  # each by itself, as live
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
