# SPDX-License-Identifier: Apache-2.0
"""Plans of real layouts: figures of a simulated run, and of the recorded ones where they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_lab.datasets.mrclam import from_polar
from rlml_lab.layout.real_runs import Look, RealRun, r2000
from rlml_lab.layout.study_plan_real import areas, compared
from rlml_lab.main import main
from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.params import Reflector
from rlml_slam.types import Detections

SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data'
real_data = pytest.mark.skipif(
    not (SHARED / 'reflector-r2000').is_dir(), reason='the data sets are not here'
)


def simulated(looks=400, hidden=(), noise=1.0):
    """Looks from anywhere in a room of 6 m with six reflectors, with the noise of the sensor."""
    rng = np.random.default_rng(4)
    points = np.array([[-3, -3], [3.5, -3], [3, 2.5], [-3, 3], [0, 3.5], [-3.5, 0.5]], float)
    sensor, found = Reflector(), []
    for k in range(looks):
        pose = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-3.0, 3.0)])
        z = se2.transform(se2.inverse(pose), points)
        r, bearing = np.hypot(*z.T), np.arctan2(z[:, 1], z[:, 0])
        sigma = np.full(6, sensor.sigma_range), np.full(6, sensor.sigma_bearing)
        r, bearing = (v + noise * s * rng.standard_normal(6)
                      for v, s in zip((r, bearing), sigma, strict=True))  # fmt: skip
        row = np.array([i for i in range(6) if i not in hidden])
        measured, cov = from_polar(r[row], bearing[row], *(s[row] for s in sigma))
        d = Detections(k, 'laser', measured, cov, row, np.full(len(row), np.nan))
        found.append(Look(pose, d))
    return RealRun('simulated', points, 0.08, sensor, 2.0 * np.pi, found)


def test_errors_and_innovations_are_as_planned_with_the_noise_of_the_plan():
    all_of_it, *others = areas(simulated())
    assert (all_of_it['in_view'], all_of_it['poses']) == (6.0, 400)
    # 400 errors of one axis: 1 sigma is 3.5 %; the gate leaves out 0.3 %
    assert all_of_it['ratio'] == pytest.approx(1.0, abs=0.12)
    assert all_of_it['innovation'] == pytest.approx(1.0, abs=0.1)
    assert all_of_it['outside_share'] < 0.01
    assert sum(r['looks'] for r in others) <= 400


def test_what_is_planned_and_not_seen_shows():
    row = areas(simulated(hidden=(0, 1)))[0]
    assert row['in_view'] == 6.0
    assert row['seen'] == pytest.approx(4.0, abs=0.05)
    assert row['planned_of_seen_m'] > 1.1 * row['planned_m']


def test_noise_above_the_plan_shows():
    row = areas(simulated(noise=2.0))[0]
    assert row['innovation'] > 1.5
    assert row['outside_share'] > 0.1


def test_a_detection_of_something_else_is_outside():
    run = simulated(1)
    seen = run.looks[0].seen
    wrong = replace(seen, ids=seen.ids[[1, 0, 2, 3, 4, 5]])
    found = compared(replace(run, looks=[replace(run.looks[0], seen=wrong)]))
    assert (found['outside'][0], found['seen'][0]) == (2, 4)


def test_a_data_set_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileFormatError, match='author_detections_pos0'):
        r2000(tmp_path)


@real_data
def test_real_runs_are_beside_their_plans(capsys):
    assert main(['study', 'plan-real', str(SHARED), '--json']) == 0
    rows = json.loads(capsys.readouterr().out)['areas']
    whole = {r['run']: r for r in rows if r['area'] == 'all'}
    laser, robot, cameras = whole.values()
    assert (laser['in_view'], laser['seen'], laser['outside_share']) == (8.0, 8.0, 0.0)
    assert 0.8 < laser['ratio'] < 1.25
    assert 0.8 < robot['ratio'] < 1.25
    assert 0.8 < robot['seen'] / robot['in_view'] <= 1.0
    # a camera reads fewer barcodes than are in its picture, and not less accurately than it states
    assert cameras['seen'] < 0.5 * cameras['in_view']
    assert cameras['ratio'] < 1.0
    assert {r['run'] for r in rows if r['area'] != 'all'} == {'LEGO robot', 'MR.CLAM 6'}
