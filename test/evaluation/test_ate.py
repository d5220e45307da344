# SPDX-License-Identifier: Apache-2.0
"""Absolute trajectory error against cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import InputError
from rlml_slam.evaluation.ate import interpolate, trajectory_errors

SECOND = 1_000_000_000


def trajectory(seconds, poses):
    return Trajectory(
        np.round(np.array(seconds) * SECOND).astype(np.int64), np.array(poses, dtype=np.float64)
    )


def wavy(n=40):
    s = np.linspace(0.0, 4.0, n)
    return trajectory(0.1 * np.arange(n) + 1.0, np.stack([s, np.sin(s), np.cos(s)], -1))


def test_figures_by_hand():
    truth = trajectory([1.0, 1.1, 1.2], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    estimate = trajectory([1.0, 1.1, 1.2], [[0, 0, 0], [1, 0.3, 0.1], [2.4, 0, -0.1]])
    s = trajectory_errors(estimate, truth).summary()
    assert s['matched'] == 3
    assert_allclose(s['rmse_m'], np.sqrt((0.09 + 0.16) / 3))
    assert_allclose([s['mean_m'], s['median_m'], s['max_m']], [0.7 / 3, 0.3, 0.4])
    assert_allclose(s['last_m'], 0.4)
    assert_allclose(s['std_m'], np.sqrt(0.25 / 3 - (0.7 / 3) ** 2))
    assert_allclose(s['heading_rmse_deg'], np.degrees(np.sqrt(0.02 / 3)))


def test_truth_is_interpolated_between_its_poses():
    truth = trajectory([1.0, 1.4], [[0, 0, 3.0], [4, 0, -3.0]])
    poses, known = interpolate(truth, np.array([1_100_000_000]))
    assert known.all()
    # a quarter of the short way round
    step = (2 * np.pi - 6.0) / 4
    assert_allclose(poses, [[1.0, 0.0, 3.0 + step]])


def test_truth_is_not_interpolated_over_a_gap():
    truth = trajectory([1.0, 3.0, 3.2], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    _, known = interpolate(truth, np.array([0, 1, 2, 3, 31, 33, 40]) * SECOND // 10 + SECOND * 0)
    assert known.tolist() == [False] * 4 + [True, False, False]
    # at its own stamps it is known all the same
    _, known = interpolate(truth, truth.stamps)
    assert known.all()


@given(st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(-3.1, 3.1)))
def test_alignment_finds_the_move(move):
    truth = wavy()
    T = np.array(move)
    moved = Trajectory(truth.stamps, se2.compose(T, truth.poses))
    errors = trajectory_errors(moved, truth, aligned=True)
    assert_allclose(errors.distances, 0.0, atol=1e-12)
    assert_allclose(errors.errors[:, 2], 0.0, atol=1e-12)
    assert_allclose(se2.between(se2.inverse(T), errors.T_truth_map), 0.0, atol=1e-12)


def test_alignment_is_a_minimum():
    rng = np.random.default_rng(1)
    p = rng.normal(size=(30, 2))
    q = p + 0.3 * rng.normal(size=(30, 2))
    T = se2.align(p, q)

    def cost(T):
        return float(((se2.transform(T, p) - q) ** 2).sum())

    best = cost(T)
    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 1e-3:
        assert cost(T + step) > best


def test_without_alignment_a_shift_is_an_error():
    truth = wavy()
    moved = Trajectory(truth.stamps, truth.poses + np.array([0.3, 0.4, 0.0]))
    assert_allclose(trajectory_errors(moved, truth).distances, 0.5)


def test_truth_without_headings_compares_positions():
    truth = wavy()
    blind = Trajectory(truth.stamps, truth.poses * [1.0, 1.0, np.nan])
    s = trajectory_errors(truth, blind).summary()
    assert s['rmse_m'] == 0.0
    assert 'heading_rmse_deg' not in s


def test_no_common_time_is_an_error():
    truth = wavy()
    later = Trajectory(truth.stamps + 100 * SECOND, truth.poses)
    with pytest.raises(InputError, match='no time in common'):
        trajectory_errors(later, truth)
