# SPDX-License-Identifier: Apache-2.0
"""The EKF study: association checked by true positions, the NEES of many drives, the page."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_lab.ekf import study_ekf_consistency as consistency
from rlml_lab.ekf.association_truth import AssociationLog, association_figures
from rlml_lab.ekf.study_ekf_report import verdicts
from rlml_lab.main import main
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.estimation.landmark_models import POINT, line_model
from rlml_slam.types import Reflectors

STAMPS = np.arange(4, dtype=np.int64) * 100_000_000
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [2.0, 1.0, -0.8], [2.0, 2.0, 3.0]])
PLACES = np.array([[4.0, 1.0], [5.0, -2.0]])


def landmarks(points):
    n = len(points)
    return Reflectors(
        np.arange(n), np.asarray(points), np.zeros((n, 2, 2)), np.full(n, -1),
        np.full(n, 9), np.full(n, np.nan),
    )  # fmt: skip


def log_of(keys):
    """Both places seen from all poses, taken for ``keys`` (4, 2)."""
    log = AssociationLog()
    for stamp, (x, y, a), row in zip(STAMPS, POSES, keys, strict=True):
        c, s = np.cos(a), np.sin(a)
        log.stamps.append(int(stamp))
        log.points.append((PLACES - [x, y]) @ np.array([[c, -s], [s, c]]))
        log.keys.append(np.array(row))
        log.used.append(np.array(row) >= 0)
    return log


def figures_of(keys, points=PLACES):
    truth = Trajectory(STAMPS, POSES)
    return association_figures(log_of(keys), truth, landmarks(points), POINT)


def test_right_matches_have_precision_and_recall_of_one():
    figures = figures_of([(0, 1)] * 4)
    assert figures['precision'] == figures['recall'] == 1.0
    assert_allclose(figures['landmark_rmse_m'], 0.0, atol=1e-12)


def test_exchanged_landmarks_cost_precision():
    figures = figures_of([(0, 1), (0, 1), (0, 1), (1, 0)])
    assert figures['precision'] == pytest.approx(6 / 8)
    # of the three later sightings of each place, one was used for the other
    assert figures['recall'] == pytest.approx(4 / 6)


def test_detections_left_out_cost_recall_alone():
    figures = figures_of([(0, 1), (0, -1), (0, 1), (0, 1)])
    assert figures['precision'] == 1.0
    assert figures['recall'] == pytest.approx(5 / 6)


def test_landmark_error_is_that_of_the_map():
    figures = figures_of([(0, 1)] * 4, PLACES + np.array([0.3, 0.4]))
    assert figures['landmark_rmse_m'] == pytest.approx(0.5)


def test_without_any_match_nothing_is_claimed():
    assert set(figures_of([(-1, -1)] * 4).values()) == {None}


def test_a_wall_is_in_one_place_from_everywhere():
    # y = 3: its foot point in the base frame, from every pose
    model = line_model(np.zeros(2))
    log = AssociationLog()
    for stamp, (_, y, a) in zip(STAMPS, POSES, strict=True):
        rho, alpha = 3.0 - y, 0.5 * np.pi - a
        log.stamps.append(int(stamp))
        log.points.append(rho * np.array([[np.cos(alpha), np.sin(alpha)]]))
        log.keys.append(np.zeros(1, dtype=np.int64))
        log.used.append(np.ones(1, dtype=np.bool_))
    truth = Trajectory(STAMPS, POSES)
    figures = association_figures(log, truth, landmarks([[0.0, 3.0]]), model)
    assert figures['precision'] == figures['recall'] == 1.0
    assert_allclose(figures['landmark_rmse_m'], 0.0, atol=1e-9)


def drives(scale, seeds=60, n=50):
    """Runs whose errors have ``scale`` times the believed variance."""
    rng = np.random.default_rng(5)
    out = []
    for _ in range(seeds):
        e = np.sqrt(scale) * rng.standard_normal((n, 3))
        stamps = np.arange(n, dtype=np.int64) * 10**8
        out.append(consistency.CaseErrors(stamps, (e**2).sum(axis=1), e[:, 2], np.abs(e[:, 0])))
    return consistency.series(out)


def test_true_covariance_lies_inside_the_bounds():
    summary = drives(1.0).summary()
    low, high = summary['bounds']
    assert low < 3.0 < high
    # 50 instants, 5 % outside expected: more than 9 has a chance below 1e-3
    assert summary['share_inside'] >= 0.82


def test_overconfident_covariance_is_called_so():
    summary = drives(2.0).summary()
    assert summary['share_above'] > 0.9
    assert 'believes too much' in verdicts({'demo, additive': summary})[0]
    assert 'consistent' in verdicts({'demo, additive': drives(1.0).summary()})[0]
    assert 'too little' in verdicts({'demo, additive': drives(0.3).summary()})[0]


def test_only_instants_known_to_all_seeds_count():
    a = consistency.CaseErrors(np.array([1, 2, 3]), np.ones(3), np.zeros(3), np.zeros(3))
    b = consistency.CaseErrors(
        np.array([2, 3, 4]), np.array([np.nan, 5, 6]), np.zeros(3), np.zeros(3)
    )
    assert_allclose(consistency.series([a, b]).nees, [[1.0], [5.0]])


def test_first_loop_ends_at_the_first_return():
    t = np.linspace(0.0, 4.0 * np.pi, 400)
    circle = np.stack([10.0 * np.cos(t), 10.0 * np.sin(t), 0.0 * t], -1)
    stamps = np.arange(400, dtype=np.int64)
    end = consistency.first_loop(Trajectory(stamps, circle))
    assert t[end] == pytest.approx(2.0 * np.pi, abs=0.15)
    # one that never returns is used whole
    assert consistency.first_loop(Trajectory(stamps[:100], circle[:100])) == 99


def test_command_writes_a_page_that_needs_nothing_else(tmp_path, capsys):
    arguments = ['study', 'ekf', '--seeds', '1', '--world', 'room', '--duration', '4',
                 '--consistency-seeds', '0', '--out', str(tmp_path), '--json']  # fmt: skip
    assert main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    drives = summary['drives']
    # what the compressed filter saves does not hang on the machine
    assert summary['speed']['look_postponed_ms'] < 0.2 * summary['speed']['look_plain_ms']
    assert drives['room, reflectors']['ate_rmse_m']['mean'] < 0.05
    assert drives['room, reflectors']['precision']['mean'] == 1.0
    assert drives['room, reflectors']['precision']['deviation'] == 0.0
    assert drives['room, dead_reckoning']['precision']['mean'] is None
    html = (tmp_path / 'report.html').read_text()
    assert 'http' not in html
    assert 'src="data:image/png' in html
    assert json.loads((tmp_path / 'results.json').read_text())['drives'].keys() == drives.keys()
