# SPDX-License-Identifier: Apache-2.0
"""A robot that is carried away: the EKF says that it is lost, and maps nothing meanwhile."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.ekf.contradiction import Contradiction
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.estimation.kidnapping_detection import FEW
from rlml_slam.params import EkfParameters, HealthLimits, from_mapping
from rlml_slam.types import ANONYMOUS, Detections, Level, Motion, Observation

RNG = np.random.default_rng(5)
HERE = RNG.uniform(-6.0, 6.0, (9, 2))
THERE = RNG.uniform(-6.0, 6.0, (9, 2)) + np.array([40.0, 0.0])
STEP, Q = np.array([0.05, 0.0, 0.1]), np.diag([0.004, 0.002, 0.004]) ** 2
PERIOD = 100_000_000  # [ns]
NONE = np.zeros(0, np.int64)


def detections(stamp, pose, ids):
    points = np.vstack([HERE, THERE])
    p = se2.transform(se2.inverse(pose), points)
    near = np.flatnonzero(np.hypot(*p.T) < 14.0)
    cov = np.repeat(1e-4 * np.eye(2)[None], len(near), 0)
    given = near if ids else np.full(len(near), ANONYMOUS)
    return Detections(
        stamp, 'base_link', p[near], cov, given.astype(np.int64), np.full(len(near), np.nan)
    )


def drive(estimator, poses, first=1, ids=False):
    frames = []
    for k, pose in enumerate(poses):
        stamp = (first + k) * PERIOD
        motion = Motion(STEP, Q) if first + k > 1 else Motion(np.zeros(3), np.zeros((3, 3)))
        frames.append(estimator.process(Observation(stamp, motion, None, None,
                                                    detections(stamp, pose, ids))))  # fmt: skip
    return frames


def circle(n, start):
    out = [np.asarray(start, dtype=float)]
    while len(out) < n:
        out.append(se2.compose(out[-1], STEP))
    return out


def estimator(**changes):
    return Estimator(from_mapping(changes, EkfParameters))


@pytest.mark.parametrize('ids', [False, True])
def test_robot_that_is_carried_away_is_lost_in_a_map_in_the_making(ids):
    e = estimator()
    here = drive(e, circle(50, [0.0, 0.0, 0.0]), ids=ids)
    assert all(f.health.level is Level.OK for f in here)
    known = len(e.reflectors())
    there = drive(e, circle(30, [40.0, 0.0, 1.0]), first=51, ids=ids)
    late = int(e._p.health.lost_time * 1e9) // PERIOD + 1
    assert all(f.health.level is Level.LOST for f in there[late:])
    assert 'set its pose' in there[-1].health.reasons[0]
    assert len(e.reflectors()) == known


def test_mapping_goes_on_after_a_while_in_a_second_part():
    """It may have driven through a door."""
    e = estimator()
    drive(e, circle(50, [0.0, 0.0, 0.0]), ids=True)
    known = len(e.reflectors())
    frames = drive(e, circle(100, [40.0, 0.0, 1.0]), first=51, ids=True)
    patience = e._p.health.new_session_time
    later = [f for f in frames if (f.stamp - frames[0].stamp) * 1e-9 > patience + 1.0]
    assert len(e.reflectors()) > known
    assert all(f.health.level is Level.DEGRADED for f in later)
    assert 'two parts' in later[-1].health.reasons[0]


def test_second_part_is_joined_by_landmarks_of_the_first():
    limits = HealthLimits()
    c, k = Contradiction(limits), 0

    def check(n, used, seconds):
        nonlocal k
        for _ in range(round(10 * seconds)):
            k += 1
            c.check(k * PERIOD, n, np.array(used, dtype=np.int64), 7, True)
        return c.holds, c.is_lost, c.reason

    assert check(6, [1, 2, 3, 4], 2.0) == (False, False, '')
    assert check(FEW, [], 2.0) == (False, False, '')  # they may be ghosts
    check(6, [1, 2, 3, 4], 1.0)
    assert check(6, [], 0.2)[:2] == (True, False)
    holds, is_lost, reason = check(6, [], limits.lost_time)
    assert (holds, is_lost) == (True, True)
    assert 'set its pose' in reason
    assert check(6, [], limits.new_session_time)[0] is False
    holds, is_lost, reason = check(6, [7, 8, 9], 1.0)
    assert (holds, is_lost) == (False, False)
    assert 'two parts' in reason
    assert check(6, [1, 2, 3, 9], 0.1) == (False, False, '')


def test_in_a_saved_map_it_lasts_until_reflectors_agree():
    limits = HealthLimits()
    c = Contradiction(limits)
    for k in range(1, 200):
        c.check(k * PERIOD, 6, NONE, 7, False)
    assert (c.holds, c.is_lost) == (True, True)
    c.check(200 * PERIOD, 6, np.arange(5), 7, False)
    assert (c.holds, c.is_lost, c.reason) == (False, False, '')
