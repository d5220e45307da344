# SPDX-License-Identifier: Apache-2.0
"""Which of topic and /tf is the motion, and how far they are apart."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.motion import SECOND
from rlml_slam.sensing.synchronization.odometry_sources import (
    TF,
    TOPIC,
    OdometrySources,
    PoseHistory,
)
from rlml_slam.types import Odometry

STEP = np.array([0.02, 0.0, 0.01])  # in 20 ms
ELSEWHERE = np.array([30.0, -8.0, 2.0])


def path(scale=1.0, turn=0.0, start=ELSEWHERE):
    """Samples of a robot on a circle, every 20 ms from 1 s on."""
    pose, step = np.array(start), np.array([scale * STEP[0], 0.0, STEP[2] + 0.02 * turn])
    for k in range(3000):
        yield Odometry(SECOND + k * SECOND // 50, pose)
        pose = se2.compose(pose, se2.exp(step))


def used(sources, *given):
    return [s for source, sample in given if (s := sources.use(source, sample)) is not None]


@pytest.mark.parametrize(('wanted', 'start'), [('auto', 2.0), ('tf', 2.0), ('topic', 0.0)])
def test_the_wanted_source_is_the_motion(wanted, start):
    sources = OdometrySources(wanted, 10.0)
    on_tf, topic = list(path(start=[2.0, 0, 0]))[:50], list(path(start=[0.0, 0, 0]))[:50]
    found = used(
        sources,
        *(g for a, b in zip(on_tf, topic, strict=True) for g in ((TF, a), (TOPIC, b))),
    )
    assert len(found) == 50
    assert found[0].pose[0] == start
    assert sources.transforms.newest == on_tf[-1].stamp


def test_a_transform_that_comes_late_and_goes_leaves_the_motion_smooth():
    """The poses of the other source, in a frame of its own, continue those of the first."""
    sources = OdometrySources('auto', 30.0)
    topic, on_tf = list(path(start=np.zeros(3))), list(path())
    found = used(
        sources,
        *((TOPIC, s) for s in topic[:100]),
        *(g for k in range(100, 300) for g in ((TOPIC, topic[k]), (TF, on_tf[k]))),
        *((TOPIC, s) for s in topic[300:500]),
    )
    assert sources.source == TOPIC
    for a, b in itertools.pairwise(found):
        dt = (b.stamp - a.stamp) / SECOND
        np.testing.assert_allclose(
            se2.log(se2.between(a.pose, b.pose)), STEP / 0.02 * dt, atol=1e-6
        )
    assert found[-1].stamp == topic[499].stamp


def test_history_is_linear_as_tf2_has_it():
    history = PoseHistory(10.0)
    history.add(Odometry(100, np.array([0.0, 0.0, 3.1])))
    history.add(Odometry(200, np.array([1.0, 2.0, -3.1])))
    x, y, theta = history.at(150)
    assert (x, y) == (0.5, 1.0)
    assert abs(se2.wrapped(theta)) == pytest.approx(math.pi)
    assert history.at(99) is None
    assert history.at(201) is None


@pytest.mark.parametrize(
    ('scale', 'per_minute', 'differ'),
    [
        (1.0, 0.0, False),
        (1.01, 0.5, False),
        (1.05, 3.0, True),
        (1.0, 10.0, False),
        (1.1, 0.0, True),
    ],
)
def test_sources_that_differ_by_more_than_their_calibration_are_found(scale, per_minute, differ):
    sources = OdometrySources('auto', 30.0)
    drifting = path(scale, math.radians(per_minute) / 60.0)
    for a, b in zip(drifting, path(), strict=True):
        used(sources, (TF, a), (TOPIC, b))
    found = sources.comparison
    assert found.differ is differ
    assert found.way == pytest.approx(scale - 1.0, abs=0.005)
    assert math.degrees(found.turn) * 60.0 == pytest.approx(per_minute, abs=0.3)
    assert 'of the way' in str(found)
