# SPDX-License-Identifier: Apache-2.0
"""The figures of a run against a run whose errors are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_runs import circle, made_run, reflectors
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import metrics, nees, reflector_figures

# what every metrics.json has
KEYS = {
    'scans', 'duration_s', 'wall_s', 'real_time_factor', 'front_end_ms', 'back_end_ms',
    'keyframes', 'closures', 'reflectors', 'peak_rss_mb', 'inputs',
}  # fmt: skip
TRUTH_KEYS = {'ate_rmse_m', 'heading_rmse_deg', 'nees_mean'}


def test_figures_by_hand():
    f = metrics(made_run())
    assert f.keys() >= KEYS | TRUTH_KEYS
    assert (f['scans'], f['keyframes'], f['reflectors']) == (60, 12, 2)
    assert (f['duration_s'], f['wall_s'], f['real_time_factor']) == (59.0, 2.0, 29.5)
    assert f['closures'] == {'accepted': 1, 'rejected': 2}
    assert f['back_end_ms'] == {'median': 2.5, 'p99': pytest.approx(3.97), 'max': 4.0}
    assert f['ate_rmse_m'] == 0.0
    assert f['live_ate_rmse_m'] == pytest.approx(0.03)
    # one of three axes is off by one sigma
    assert f['nees_mean'] == pytest.approx(1.0)
    assert f['reflector_rmse_m'] == pytest.approx(0.05)
    assert f['health'] == {'OK': 0.8333, 'DEGRADED': 0.1667, 'LOST': 0.0}
    assert json.loads(json.dumps(f)) == f


def test_without_truth_the_rest_is_there():
    run = made_run()
    run.truth = None
    f = metrics(run)
    assert f.keys() >= KEYS
    assert not TRUTH_KEYS & f.keys()


def test_truth_in_a_frame_of_its_own_is_aligned():
    run = made_run(is_map=False)
    T = np.array([5.0, -3.0, 2.0])
    path = run.truth.trajectory
    run.truth = type(run.truth)(
        Trajectory(path.stamps, se2.compose(T, path.poses)), False,
        run.truth.reflector_ids, se2.transform(T, run.truth.reflectors),
    )  # fmt: skip
    f = metrics(run)
    assert f['alignment'] == 'se2'
    assert f['ate_rmse_m'] == pytest.approx(0.0, abs=1e-6)
    # a constant shift is what alignment takes away
    assert f['live_ate_rmse_m'] == pytest.approx(0.0, abs=1e-6)
    assert f['reflector_rmse_m'] == pytest.approx(0.05, abs=1e-6)
    # the covariance is about the first pose, which the fit does not keep
    assert 'nees_mean' not in f


def test_truth_of_another_time_is_none():
    run = made_run()
    path = run.truth.trajectory
    later = Trajectory(path.stamps + 10**15, path.poses)
    run.truth = type(run.truth)(later, True)
    assert 'ate_rmse_m' not in metrics(run)


def test_truth_that_is_too_sparse_for_any_scan_is_none():
    run = made_run()
    path = run.truth.trajectory
    stamps = path.stamps[[0, -1]] + 1
    run.truth = type(run.truth)(Trajectory(stamps, path.poses[[0, -1]]), True)
    assert 'ate_rmse_m' not in metrics(run)


def test_nees_of_consistent_errors_is_three():
    rng = np.random.default_rng(5)
    truth = circle(4000)
    A = np.array([[0.05, 0.01, 0.0], [0.0, 0.03, 0.002], [0.0, 0.0, 0.01]])
    errors = rng.normal(size=(4000, 3)) @ A
    estimate = Trajectory(truth.stamps, truth.poses + errors)
    covs = np.broadcast_to(A.T @ A, (4000, 3, 3))
    values = nees(trajectory_errors(estimate, truth), covs)
    # standard deviation of the mean of chi^2(3): sqrt(6 / 4000) = 0.04
    assert values.mean() == pytest.approx(3.0, abs=0.16)


def test_nees_does_not_depend_on_the_frame_of_the_truth():
    rng = np.random.default_rng(6)
    truth = circle(200)
    estimate = Trajectory(truth.stamps, truth.poses + 0.02 * rng.normal(size=(200, 3)))
    covs = np.broadcast_to(np.diag([4e-4, 1e-4, 2e-4]), (200, 3, 3))
    moved = Trajectory(truth.stamps, se2.compose(np.array([1.0, 2.0, 0.7]), truth.poses))
    a = nees(trajectory_errors(estimate, truth, aligned=True), covs)
    b = nees(trajectory_errors(estimate, moved, aligned=True), covs)
    assert_allclose(a, b, rtol=1e-9)


def test_first_pose_without_covariance_is_left_out():
    truth = circle(3)
    covs = np.array([np.zeros((3, 3)), np.eye(3), np.eye(3)])
    assert np.isnan(nees(trajectory_errors(truth, truth), covs)).tolist() == [True, False, False]


def test_reflectors_are_matched_by_id_and_by_place():
    run = made_run()
    run.reflectors = reflectors(
        [[4.1, 0.0], [4.0, 0.2], [0.0, -9.0], [5.0, 6.0]], ids=[-1, 0, -1, 2]
    )
    f = reflector_figures(run, np.zeros(3))
    # the last is far off, but says that it is number 2
    assert (f['reflectors_found'], f['reflectors_twice'], f['reflectors_spurious']) == (2, 1, 1)
    assert f['reflector_rmse_m'] == pytest.approx(np.sqrt((0.01 + 0.04 + 26.0) / 3))
