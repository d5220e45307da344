# SPDX-License-Identifier: Apache-2.0
"""The front end's study: its faults are what they say, its figures are those of the frames."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rlml_lab.main import main
from rlml_lab.studies import study_front_end as study
from rlml_lab.support.drives import simulate
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START
from rlml_slam.types import Detections, Frame, Health, Level, Motion, Observation, Odometry, Scan


@pytest.fixture(scope='module')
def clean():
    return simulate(study.parameters_of('corridor', ''), 0)[0]


def test_dropout_leaves_half_a_second_without_scan_and_reflectors(clean):
    left = study.without_dropouts(clean)
    for kind in (Scan, Detections):
        stamps = np.array([m.stamp for m in left if isinstance(m, kind)])
        gaps = np.diff(stamps) / SECOND
        # five scans in a row are missing at 10 Hz, every 10 s
        assert np.isclose(gaps.max(), 0.6, atol=0.011)
        assert (gaps > 0.3).sum() == (stamps[-1] - START) // (10 * SECOND)
    count = [sum(isinstance(m, Odometry) for m in some) for some in (clean, left)]
    assert count[0] == count[1]


def test_ghosts_are_half_of_all_and_two_fifths_are_missed(clean):
    counts = {'': [m for m in clean if isinstance(m, Detections)]}
    for fault in ('ghosts', 'missed'):
        messages, _ = simulate(study.parameters_of('corridor', fault), 0)
        counts[fault] = [m for m in messages if isinstance(m, Detections)]
    mean = {fault: np.mean([len(m) for m in seen]) for fault, seen in counts.items()}
    assert mean['ghosts'] / mean[''] == pytest.approx(2.0, abs=0.15)
    assert mean['missed'] / mean[''] == pytest.approx(0.6, abs=0.05)


def test_figures_are_those_of_the_frames():
    stamps = np.arange(1, 101) * SECOND // 10
    true = np.stack([stamps * 1e-9, np.zeros(100), np.zeros(100)], -1)
    cov = np.diag([0.02**2, 0.02**2, 0.01**2])
    none = np.zeros(0, dtype=np.int64)
    frames = []
    for k in range(100):
        pose = true[k] + ([0.03, 0.04, 0.01] if k % 2 else [0.0, 0.0, 0.0])
        health = Health(Level.LOST if k < 10 else Level.OK)
        o = Observation(int(stamps[k]), Motion(np.zeros(3), cov))
        frames.append(Frame(int(stamps[k]), o, pose, cov, pose, cov, none, none, health))
    f = study.figures_of(frames, Truth(Trajectory(stamps, true), True))
    assert f['ate_m'] == pytest.approx(0.05 / np.sqrt(2.0))
    assert f['max_m'] == pytest.approx(0.05)
    assert f['along_m'] == pytest.approx(0.03)
    assert f['nees'] == pytest.approx(0.5 * (2.25 + 4.0 + 1.0))
    assert f['coverage'] == 1.0
    assert f['lost'] == 0.1


def test_study_is_written_and_told(tmp_path, capsys):
    arguments = ['study', 'front-end', '--seeds', '1', '--world', 'corridor', '--kidnaps', '0']
    arguments += ['--sensors', 'odometry', 'both', '--fault', 'dropout', '--out', str(tmp_path)]
    assert main([*arguments, '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures == json.loads((tmp_path / 'results.json').read_text())
    drives = figures['drives']
    assert list(drives) == ['corridor, odometry', 'corridor, both', 'corridor, dropout']
    assert (
        drives['corridor, both']['ate_m']['mean'] < drives['corridor, odometry']['ate_m']['mean']
    )
    ratio = (
        drives['corridor, dropout']['ate_m']['mean'] / drives['corridor, both']['ate_m']['mean']
    )
    assert figures['robustness']['corridor, dropout']['ratio'] == pytest.approx(ratio)
    page = (tmp_path / 'report.html').read_text()
    assert 'corridor, dropout' in page
    assert 'no robot was carried away' in page
