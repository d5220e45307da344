# SPDX-License-Identifier: Apache-2.0
"""Which detection of a run is of which reflector, when all of it is known."""

import numpy as np
import pytest
from rlml.made_worlds import detections_of

from rlml_slam.params import Reflector
from rlml_slam.rlml.second_match import Marks, SecondMatch
from rlml_slam.types import ANONYMOUS

GAP = 0.18  # [m]
ROW = np.array([[3.0, -GAP], [3.0, 0.0], [3.0, GAP]])
LOOKS = 20
LAST = 14  # looks before the path goes wrong


def seen(points, looks=LOOKS, sigma=0.02):
    """The same points (k, 2) in all of the looks, from the origin, with noise."""
    rng = np.random.default_rng(8)
    return [
        detections_of(points + sigma * rng.standard_normal(points.shape), k, None, sigma)
        for k in range(looks)
    ]


def marks_at(points):
    return Marks(points, np.full(len(points), ANONYMOUS))


def answered(match, poses, marks, granted):
    marks, answers = match.answer(poses, marks, granted)
    return len(marks.points), answers.reshape(-1, len(ROW))


@pytest.mark.parametrize('aside', [-GAP, GAP])
def test_pass_that_is_off_by_a_gap_of_a_row_sees_as_many_as_there_are(aside):
    """Each fits the neighbour of its own; one at the end fits none."""
    match = SecondMatch(seen(ROW), Reflector())
    off = np.zeros((LOOKS, 3))
    off[LAST:, 1] = aside
    count, answers = answered(match, off, marks_at(ROW), 0.0)
    assert count == len(ROW) + 1  # the path is taken for true
    count, answers = answered(match, off, marks_at(ROW), Reflector().min_separation ** 2)
    assert count == len(ROW)
    assert (answers == np.arange(len(ROW))).all()


def test_one_more_than_there_are_marks_is_a_new_one_however_much_is_granted():
    match = SecondMatch(seen(ROW), Reflector())
    count, answers = answered(match, np.zeros((LOOKS, 3)), marks_at(ROW[:2]), 0.25**2)
    assert count == len(ROW)
    assert (np.sort(answers, axis=1) == np.arange(len(ROW))).all()


def test_one_cloud_of_many_detections_is_one_reflector():
    """Each is near all others, which are too many to be listed pair by pair."""
    looks = 20_000
    far = np.array([[20.0, 0.0]])
    match = SecondMatch(seen(ROW[:1], looks), Reflector())
    marks, answers = match.answer(np.zeros((looks, 3)), marks_at(far), 0.0)
    assert len(marks.points) == 1
    assert (answers == 0).mean() > 0.99
    np.testing.assert_allclose(marks.points, ROW[:1], atol=0.001)


def test_only_what_is_anonymous_is_open():
    assert SecondMatch(seen(ROW), Reflector()).is_open
    told = [detections_of(ROW, 0, [1, 2, 3])]
    assert not SecondMatch(told, Reflector()).is_open


def test_a_ghost_that_nothing_repeats_is_no_reflector():
    rng = np.random.default_rng(3)
    ghosts = rng.uniform(-30.0, 30.0, (200, 1, 2))
    looks = [detections_of(np.vstack([ROW, g]), k, None, 0.02) for k, g in enumerate(ghosts)]
    match = SecondMatch(looks, Reflector())
    marks, answers = match.answer(np.zeros((len(looks), 3)), marks_at(ROW), 0.0)
    assert len(marks.points) == len(ROW)
    assert (answers.reshape(-1, 4)[:, 3] == -1).all()
