# SPDX-License-Identifier: Apache-2.0
"""The mapper by itself: what it makes of frames, without a front end and without topics."""

from __future__ import annotations

from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest

from rlml_slam.params import Parameters
from rlml_slam.ros.frames import Record
from rlml_slam.ros.mapper import Mapper
from rlml_slam.types import Frame, Motion, Observation

SECOND = 1_000_000_000
ODOMETRY = np.array([100.0, 50.0, 1.0])


class Publisher:
    """Keeps what is sent on a topic."""

    def __init__(self, topic, sent):
        self.topic_name = topic
        self.publish = sent[topic].append


class Ear:
    """Stands in for the node: keeps messages by topic and warnings."""

    def __init__(self):
        self.sent = defaultdict(list)
        self.warnings = []

    def create_publisher(self, kind, topic, depth):
        return Publisher(topic, self.sent)

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append, info=lambda text: None)


@pytest.fixture
def ear():
    return Ear()


@pytest.fixture
def mapper(ear, monkeypatch):
    mapper = Mapper(ear, Parameters())
    transforms = ear.sent['transforms']
    monkeypatch.setattr(mapper._tf, 'publish', lambda *sent: transforms.append(sent))
    mapper.transforms = transforms
    yield mapper
    mapper.worker.close()


def give(mapper, k, pose=(0.0, 0.0, 0.0), odometry=ODOMETRY, session=1, **more):
    """The k-th frame of a robot without sensors, used and told before this returns."""
    stamp, cov = (k + 1) * SECOND // 10, 1e-4 * np.eye(3)
    observation = Observation(stamp, Motion(np.zeros(3), 1e-6 * np.eye(3)), odom_pose=odometry)
    T = np.array(pose)
    none = np.zeros(0, dtype=np.int64)
    frame = Frame(stamp, observation, T, cov, T, cov, none, none)
    mapper.add(Record(session, frame, False, False, **more))
    mapper.worker.submit(lambda: None).result()
    mapper.send_transform()
    return stamp


def test_scan_without_odometry_leaves_map_to_odom_where_it_was(mapper):
    give(mapper, 0)
    stamp = give(mapper, 1, odometry=None)
    (_, _, first), (sent, _, second) = mapper.transforms
    assert sent == stamp
    np.testing.assert_array_equal(second, first)


def test_new_session_waits_for_the_odometry_that_there_is(mapper):
    give(mapper, 0)
    give(mapper, 1, odometry=None, session=2)
    assert len(mapper.transforms) == 1
    give(mapper, 2, session=2)
    np.testing.assert_allclose(mapper.transforms[-1][2], mapper.transforms[0][2], atol=1e-12)


def test_without_any_odometry_odom_is_the_local_frame(mapper):
    give(mapper, 0, pose=(3.0, 2.0, 1.0), odometry=None)
    np.testing.assert_allclose(mapper.transforms[-1][2], np.zeros(3), atol=1e-12)
