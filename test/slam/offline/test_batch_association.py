# SPDX-License-Identifier: Apache-2.0
"""Which detection of a run is of which reflector, when all of it is known."""

import numpy as np
import pytest
from made_worlds import detections_of

from rlml_slam.params import Reflector
from rlml_slam.slam.offline.batch_association import BatchAssociation, ReflectorPoints
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
    return ReflectorPoints(points, np.full(len(points), ANONYMOUS))


def answered(match, poses, marks, extra_variance):
    marks, associations = match.associate(poses, marks, extra_variance)
    return len(marks.points), associations.reshape(-1, len(ROW))


@pytest.mark.parametrize('aside', [-GAP, GAP])
def test_pass_that_is_off_by_a_gap_of_a_row_sees_as_many_as_there_are(aside):
    """Each fits the neighbour of its own; one at the end fits none."""
    match = BatchAssociation(seen(ROW), Reflector())
    off = np.zeros((LOOKS, 3))
    off[LAST:, 1] = aside
    count, associations = answered(match, off, marks_at(ROW), 0.0)
    assert count == len(ROW) + 1  # the path is taken for true
    count, associations = answered(match, off, marks_at(ROW), Reflector().min_separation ** 2)
    assert count == len(ROW)
    assert (associations == np.arange(len(ROW))).all()


def test_one_more_than_there_are_marks_is_a_new_one_however_much_is_granted():
    match = BatchAssociation(seen(ROW), Reflector())
    count, associations = answered(match, np.zeros((LOOKS, 3)), marks_at(ROW[:2]), 0.25**2)
    assert count == len(ROW)
    assert (np.sort(associations, axis=1) == np.arange(len(ROW))).all()


def test_one_cloud_of_many_detections_is_one_reflector():
    """Each is near all others, which are too many to be listed pair by pair."""
    looks = 20_000
    far = np.array([[20.0, 0.0]])
    match = BatchAssociation(seen(ROW[:1], looks), Reflector())
    marks, associations = match.associate(np.zeros((looks, 3)), marks_at(far), 0.0)
    assert len(marks.points) == 1
    assert (associations == 0).mean() > 0.99
    np.testing.assert_allclose(marks.points, ROW[:1], atol=0.001)


def test_only_what_is_anonymous_is_open():
    assert BatchAssociation(seen(ROW), Reflector()).is_ambiguous
    with_ids = [detections_of(ROW, 0, [1, 2, 3])]
    assert not BatchAssociation(with_ids, Reflector()).is_ambiguous


def test_a_ghost_that_nothing_repeats_is_no_reflector():
    rng = np.random.default_rng(3)
    ghosts = rng.uniform(-30.0, 30.0, (200, 1, 2))
    looks = [detections_of(np.vstack([ROW, g]), k, None, 0.02) for k, g in enumerate(ghosts)]
    match = BatchAssociation(looks, Reflector())
    marks, associations = match.associate(np.zeros((len(looks), 3)), marks_at(ROW), 0.0)
    assert len(marks.points) == len(ROW)
    assert (associations.reshape(-1, 4)[:, 3] == -1).all()


def joined(groups, points, sigma=0.1, ids=None):
    """Reflectors left after joining; ``groups``: those in each look; stated sigma 0.02 m."""
    rng, points = np.random.default_rng(0), np.array(points)
    marks = ReflectorPoints(
        points, np.full(len(points), ANONYMOUS) if ids is None else np.array(ids)
    )
    looks = []
    for k, group in enumerate(map(list, groups)):
        seen = points[group] + sigma * rng.standard_normal((len(group), 2))
        looks.append(detections_of(seen, k, marks.ids[group], 0.02))
    match = BatchAssociation(looks, Reflector())
    match.associate(np.zeros((len(looks), 3)), marks, 0.0)  # takes the detections to the map
    return match.joined(marks, np.concatenate(groups))


def test_a_cloud_that_no_look_has_two_of_is_one():
    """It lies where the detections of both say; all of them are its own."""
    marks, associations = joined([[0], [1], [1], [1]] * 50, [[2.0, 1.0], [2.0, 1.2]])
    np.testing.assert_allclose(marks.points, [[2.0, 1.15]], atol=0.03)
    assert (associations == 0).all()


@pytest.mark.parametrize(
    ('groups', 'gap', 'sigma'),
    [
        ([[0], [1]] * 50 + [[0, 1]], 0.2, 0.1),  # one look has two of them
        ([[0], [1]] * 50, 0.3, 0.1),  # farther than reflector.min_separation
        ([[0], [1]] * 50, 0.2, 0.03),  # on either side of a pillar: a gap parts them
    ],
)
def test_what_is_seen_together_or_far_apart_or_with_a_gap_between_stays_two(groups, gap, sigma):
    marks, associations = joined(groups, [[2.0, 1.0], [2.0, 1.0 + gap]], sigma)
    assert len(marks.points) == 2
    assert set(associations.tolist()) == {0, 1}


@pytest.mark.parametrize(
    'points',
    [
        [[2.0, 1.0], [2.0, 1.12], [2.0, 1.24]],
        [[2.0, 1.0], [2.1, 1.24], [1.9, 1.24]],  # the first is near the middle of the others only
    ],
)
def test_what_becomes_near_by_joining_is_joined(points):
    marks, _ = joined([[0], [1], [2]] * 50, points)
    assert len(marks.points) == 1


def test_what_was_seen_with_a_part_is_not_joined_with_the_whole():
    points = [[2.0, 1.0], [2.0, 1.09], [2.0, 1.2]]
    marks, associations = joined([[0], [1, 2]] * 50, points)
    assert len(marks.points) == 2
    of = associations.reshape(-1, 3)
    assert (of[:, 0] != of[:, 2]).all()
    assert (of[:, 1] != of[:, 2]).all()


@pytest.mark.parametrize(('ids', 'left'), [((7, 8), [7, 8]), ((-1, 7), [7]), ((7, -1), [7])])
def test_ids_are_kept_and_not_mixed(ids, left):
    marks, _ = joined([[0], [1]] * 50, [[2.0, 1.0], [2.0, 1.2]], ids=ids)
    assert marks.ids.tolist() == left


def test_without_any_nothing_is_joined():
    match = BatchAssociation([detections_of([[1.0, 1.0]], 0)], Reflector())
    none = ReflectorPoints(np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    marks, associations = match.joined(none, np.array([-1]))
    assert len(marks.points) == 0
    assert associations.tolist() == [-1]


def test_a_cloud_that_scatters_more_than_it_tells_is_not_spread_over_many():
    """A person with a reflecting vest, among reflectors that scatter as stated."""
    rng, num = np.random.default_rng(0), 400
    still = np.array([[2.0, 1.0], [5.0, 1.0], [5.0, 4.0], [2.0, 4.0]])
    at = still + np.array([0.12, 0.02, 0.02, 0.02])[:, None] * rng.standard_normal((num, 4, 2))
    match = BatchAssociation(
        [detections_of(p, k, None, 0.02) for k, p in enumerate(at)], Reflector()
    )
    marks, associations = match.associate(np.zeros((num, 3)), marks_at(still), 0.0)
    before = len(marks.points) - 3
    marks, _ = match.joined(marks, associations)
    assert before > 4
    assert len(marks.points) - 3 <= before // 2
