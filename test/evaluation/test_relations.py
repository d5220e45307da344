# SPDX-License-Identifier: Apache-2.0
"""The metric of Kümmerle et al. against cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError, InputError
from rlml_slam.evaluation.relations import Relations, nearest, read_relations, relation_errors

SECOND = 1_000_000_000


def stamps(*seconds):
    return np.round(np.array(seconds) * SECOND).astype(np.int64)


def corner():
    """One metre ahead, then a quarter turn and one metre on."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2], [1.0, 1.0, np.pi / 2]])
    return Trajectory(stamps(1.0, 2.0, 3.0), poses)


def relations_of(trajectory, pairs, error=(0.0, 0.0, 0.0)):
    i = np.array(pairs)
    delta = se2.between(trajectory.poses[i[:, 0]], trajectory.poses[i[:, 1]])
    return Relations(trajectory.stamps[i], se2.compose(delta, np.array(error)))


def test_true_relations_give_no_error():
    t = corner()
    errors = relation_errors(t, relations_of(t, [(0, 1), (0, 2), (2, 1)]))
    assert_allclose(errors.trans, 0.0, atol=1e-15)
    assert_allclose(errors.rot, 0.0, atol=1e-15)


def test_error_is_that_of_the_relation():
    # d = inverse(relation) * delta = inverse(error): 3-4-5 triangle, 0.1 rad
    t = corner()
    errors = relation_errors(t, relations_of(t, [(0, 1)], (0.3, 0.4, -0.1)))
    assert_allclose(errors.trans, [0.5], rtol=1e-12)
    assert_allclose(errors.rot, [0.1], rtol=1e-12)


def test_summary_by_hand():
    t = corner()
    exact, wrong = relations_of(t, [(0, 1)]), relations_of(t, [(1, 2)], (0.3, 0.4, 0.2))
    both = Relations(
        np.concatenate([exact.stamps, wrong.stamps]), np.concatenate([exact.deltas, wrong.deltas])
    )
    s = relation_errors(t, both).summary()
    assert s['relations'] == 2
    assert s['relations_unmatched'] == 0
    assert_allclose([s['trans_mean_m'], s['trans_std_m'], s['trans_max_m']], [0.25, 0.25, 0.5])
    assert_allclose([s['trans_squared_mean_m2'], s['trans_squared_std_m2']], [0.125, 0.125])
    half = np.degrees(0.1)
    assert_allclose([s['rot_mean_deg'], s['rot_std_deg']], [half, half])
    assert_allclose(s['rot_squared_mean_deg2'], 2.0 * half**2)


@given(st.tuples(*(st.floats(-50.0, 50.0) for _ in range(3))))
def test_moving_the_estimate_changes_nothing(move):
    t = corner()
    moved = Trajectory(t.stamps, se2.compose(np.array(move), t.poses))
    r = relations_of(t, [(0, 1), (0, 2), (1, 2)], (0.1, -0.2, 0.05))
    a, b = relation_errors(t, r), relation_errors(moved, r)
    # 50 m away, 1e-14 relative
    assert_allclose(a.trans, b.trans, atol=1e-12)
    assert_allclose(a.rot, b.rot, atol=1e-12)


def test_relation_without_a_pose_is_counted():
    t = corner()
    good = relations_of(t, [(0, 1)] * 19)
    r = Relations(
        np.concatenate([good.stamps, [stamps(1.0, 2.5)]]),
        np.concatenate([good.deltas, np.zeros((1, 3))]),
    )
    errors = relation_errors(t, r)
    assert errors.unmatched == 1
    assert len(errors.trans) == 19


def test_too_many_unmatched_relations_are_an_error():
    t = corner()
    r = Relations(np.array([stamps(1.0, 2.0), stamps(1.0, 2.5)]), np.zeros((2, 3)))
    with pytest.raises(InputError, match=r'1 of 2 relations have no pose within 0\.001 s'):
        relation_errors(t, r)


def test_nearest_stamp_is_found():
    t = stamps(1.0, 2.0, 4.0)
    wanted = stamps(0.0, 1.4, 1.6, 2.0, 3.1, 9.0)
    assert_array_equal(nearest(t, wanted), [0, 0, 1, 1, 2, 2])
    assert_array_equal(nearest(stamps(5.0), wanted), np.zeros(6))


@pytest.mark.parametrize(
    ('line', 'why'), [('1 2 3', '3 values, 8 expected'), ('1 2 a 0 0 0 0 0', 'could not convert')]
)
def test_bad_line_is_named(tmp_path, line, why):
    path = tmp_path / 'x.relations'
    path.write_text(f'1.0 2.0 1 0 0 0 0 0.5\n{line}\n')
    with pytest.raises(FileFormatError, match=rf'x\.relations:2: {why}'):
        read_relations(path)


def test_file_of_relations_is_read(tmp_path):
    path = tmp_path / 'x.relations'
    path.write_text('1.000001 2.5 1 -2 0 0 0 0.5\n')
    r = read_relations(path)
    assert_array_equal(r.stamps, [stamps(1.000001, 2.5)])
    assert_allclose(r.deltas, [[1.0, -2.0, 0.5]])
