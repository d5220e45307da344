# SPDX-License-Identifier: Apache-2.0
"""The last pose in a saved map: written when sure, restored when verified."""

import numpy as np
import pytest

from rlml_slam.errors import FileFormatError
from rlml_slam.ros.back_end.last_pose import PERIOD, LastPose
from rlml_slam.slam.relocalization.pose_test import NEAR, verified
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Frame, Health, Level, Motion, Observation, Verdict

HERE = np.array([3.0, -1.0, 0.5])
COV = 1e-4 * np.eye(3)


def frame(pose=HERE, stamp=PERIOD, level=Level.OK, unconfirmed=False):
    none = np.zeros(0, dtype=np.int64)
    observation = Observation(stamp, Motion(np.zeros(3), COV))
    return Frame(
        stamp,
        observation,
        pose,
        COV,
        pose,
        COV,
        none,
        none,
        Health(level, ()),
        unconfirmed=unconfirmed,
    )


@pytest.fixture
def last(tmp_path):
    return LastPose(tmp_path / 'map.pose')


def test_pose_that_is_sure_is_written(last):
    assert last.read() is None
    last.remember(frame())
    np.testing.assert_array_equal(last.read(), HERE)


@pytest.mark.parametrize(
    'unsure', [{'level': Level.DEGRADED}, {'level': Level.LOST}, {'unconfirmed': True}]
)
def test_pose_that_is_not_sure_is_not_written(last, unsure):
    last.remember(frame(**unsure))
    assert last.read() is None


def test_file_follows_the_robot_once_a_period(last):
    last.remember(frame())
    there = HERE + np.array([0.5, 0.0, 0.0])
    last.remember(frame(there, stamp=2 * PERIOD - 1))
    np.testing.assert_array_equal(last.read(), HERE)
    last.remember(frame(there, stamp=2 * PERIOD))
    np.testing.assert_array_equal(last.read(), there)
    # a clock that was set back does not stop it
    last.remember(frame(HERE, stamp=PERIOD))
    np.testing.assert_array_equal(last.read(), HERE)


def test_file_of_a_robot_that_stands_is_left_alone(last, tmp_path):
    last.remember(frame())
    (tmp_path / 'map.pose').unlink()
    last.remember(frame(HERE + 0.005, stamp=9 * PERIOD))
    assert last.read() is None


@pytest.mark.parametrize(
    'content',
    [
        '',
        '{',
        '{"x": 1}',
        '[1, 2]',
        '{"x": NaN, "y": 0, "theta": 0}',
        f'{{"x": {10**400}, "y": 0, "theta": 0}}',
    ],
)
def test_damaged_file_is_told(last, tmp_path, content):
    (tmp_path / 'map.pose').write_text(content)
    with pytest.raises(FileFormatError, match=r'map\.pose'):
        last.read()


def test_only_a_place_that_fits_is_restored():
    near = Relocation(Verdict.UNIQUE, 'fits', HERE + 0.5 * NEAR, COV)
    start, why = verified(HERE, near)
    np.testing.assert_array_equal(start[0], near.pose)
    assert 'is restored: fits' in why
    start, why = verified(HERE, Relocation(Verdict.UNIQUE, 'fits', HERE + 2.0 * NEAR, COV))
    assert start is None
    assert 'rather at x = 4.00 m, y = 0.00 m, 57.3°' in why
    start, why = verified(HERE, Relocation(Verdict.IMPOSSIBLE, 'no place fits'))
    assert start is None
    assert 'not restored: no place fits' in why


def test_of_several_places_the_last_one_is_tried_where_it_was():
    (pose, cov), why = verified(HERE, Relocation(Verdict.AMBIGUOUS, 'two fit', -HERE, COV))
    np.testing.assert_array_equal(pose, HERE)
    assert np.sqrt(np.diag(cov)).max() <= 0.1
    assert 'is tried: two fit' in why
