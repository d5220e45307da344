# SPDX-License-Identifier: Apache-2.0
"""A robot that is carried away while the EKF localizes in a saved map."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.ekf.contradiction import MOVED, Contradiction
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.estimation.kidnapping_detection import FEW
from rlml_slam.params import EkfParameters, HealthLimits, from_mapping
from rlml_slam.types import ANONYMOUS, Detections, Level, Motion, Observation, Reflectors

RNG = np.random.default_rng(5)
HERE = RNG.uniform(-6.0, 6.0, (9, 2))
THERE = RNG.uniform(-6.0, 6.0, (9, 2)) + np.array([40.0, 0.0])
STEP, Q = np.array([0.05, 0.0, 0.1]), np.diag([0.004, 0.002, 0.004]) ** 2
PERIOD = 100_000_000  # [ns]
LIMITS = HealthLimits()
ANGLES = np.linspace(-2.5, 2.5, 6)
RING = 5.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])  # landmarks around the robot


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


def test_robot_that_is_carried_away_in_a_saved_map_is_lost_until_it_is_placed():
    e = estimator(mode='localization')
    n = len(HERE)
    known = Reflectors(
        np.arange(n), HERE, np.repeat(1e-4 * np.eye(2)[None], n, 0), np.arange(n),
        np.full(n, 9), np.full(n, np.nan),
    )  # fmt: skip
    e.reset(np.zeros(3), np.diag([0.01, 0.01, 0.001]))
    e.use_map(known)
    assert drive(e, circle(50, [0.0, 0.0, 0.0]), ids=True)[-1].health.level is Level.OK
    there = drive(e, circle(80, [40.0, 0.0, 1.0]), first=51, ids=True)
    late = int(e._p.health.confirmation_time * 1e9) // PERIOD + 1
    assert all(f.health.level is Level.DEGRADED for f in there[7 : late - 1])
    assert all(f.health.level is Level.LOST for f in there[late:])
    assert there[-1].health.reasons[0] == MOVED


class Frames:
    """Frames of a robot at rest, one after the other."""

    def __init__(self):
        self.checked, self._k = Contradiction(LIMITS), 0

    def see(self, n, used=0, seconds=0.1, near=RING):
        """``n`` detections in all directions, ``used`` of which match."""
        z = np.column_stack([np.full(n, 8.0), np.linspace(-3.0, 3.0, n)])
        for _ in range(round(10 * seconds)):
            self._k += 1
            self.checked.check(self._k * PERIOD, z, used, near)
        return self.checked.is_lost, self.checked.reason


def test_one_frame_of_ghosts_is_nothing():
    frames = Frames()
    frames.see(6, 4, 2.0)
    frames.see(3)
    for seconds in (1.0, 10.0, 600.0):
        assert frames.see(0, seconds=seconds) == (False, '')


@pytest.mark.parametrize(
    ('near', 'used'),
    [
        (RING * 3.0, 0),  # farther than anything was seen
        (RING[:2], 0),  # they may be hidden
        (np.zeros((0, 2)), 0),
        (RING, 2),  # two of seven, beside a person with bright spots
    ],
)
def test_what_need_not_be_in_view_is_not_missed(near, used):
    frames = Frames()
    frames.see(6, 4, 2.0)
    assert frames.see(7, used, 20.0, near) == (False, '')


def test_it_lasts_until_reflectors_agree():
    frames = Frames()
    assert frames.see(6, 4, 2.0) == (False, '')
    assert frames.see(FEW, 0, 2.0) == (False, '')  # they may be ghosts
    frames.see(6, 4, 1.0)
    assert frames.see(6, 0, 0.2) == (False, '')
    assert frames.see(6, 0, LIMITS.lost_time) == (False, MOVED)
    assert frames.see(6, 0, LIMITS.confirmation_time) == (True, MOVED)
    assert frames.see(6, 0, 20.0) == (True, MOVED)
    assert frames.see(6, 3) == (False, '')


def test_while_a_map_is_made_new_landmarks_are_usual():
    e = estimator()
    drive(e, circle(50, [0.0, 0.0, 0.0]), ids=True)
    known = len(e.reflectors())
    there = drive(e, circle(80, [40.0, 0.0, 1.0]), first=51, ids=True)
    assert all(f.health.level is not Level.LOST for f in there)
    assert len(e.reflectors()) > known
