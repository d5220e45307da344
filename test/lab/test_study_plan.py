# SPDX-License-Identifier: Apache-2.0
"""Studies of plans: figures of a small run, and that they notice a plan that is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rlml_lab.layout import study_plan_bound, study_plan_verdicts
from rlml_lab.layout.study_plan_bound import WORLDS, areas, estimate
from rlml_lab.layout.study_plan_verdicts import layout
from rlml_lab.main import main
from rlml_slam.params import Parameters
from rlml_slam.planning.bound import bound
from rlml_slam.planning.visibility import visible
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.types import Detections


def test_estimate_is_exact_without_noise():
    rng = np.random.default_rng(1)
    pose, points = np.array([1.0, 2.0, 0.5]), rng.uniform(-9.0, 9.0, (4, 2))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    z = (points - pose[:2]) @ np.array([[c, -s], [s, c]])
    cov = polar_covariance(z / np.hypot(*z.T)[:, None], 4e-4, np.full(4, 4e-4))
    ids = np.array([7, -1, 9, 8])
    d = Detections(1, 'laser', z, cov, ids, np.full(4, np.nan))
    error, count = estimate(pose, d, points, [7, 6, 9, 8], Parameters())
    assert count == 3  # the second is a ghost
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


@pytest.fixture(scope='module')
def ring():
    return areas(WORLDS[5], 2, False)


def test_errors_are_as_planned(ring):
    """Of about 1000 scans: the RMS of the errors is known to 3 %."""
    weight = np.array([r['scans'] for r in ring], dtype=float)
    ratio = np.array([r['ratio'] for r in ring])
    assert 0.9 < np.sqrt(np.average(ratio**2, weights=weight)) < 1.12
    assert all(r['seen'] <= r['in_view'] for r in ring)


def test_plan_of_another_noise_is_noticed(monkeypatch):
    def optimistic(places, seen, reflectors, cov, p):
        found = bound(places, seen, reflectors, cov, p)
        return found._replace(position=0.5 * found.position)

    monkeypatch.setattr(study_plan_bound, 'bound', optimistic)
    code = main(['study', 'plan-bound', '--seeds', '1', '--world', WORLDS[5]])
    assert code == 1


def test_people_have_rows_of_their_own_that_do_not_count(monkeypatch, capsys):
    def drive(name, seed, people):
        ones, planned = np.ones(40), np.full(40, 0.01)
        return np.ones((40, 2)), planned * (2.0 if people else 1.0), planned, ones, ones

    monkeypatch.setattr(study_plan_bound, 'drive', drive)
    arguments = ['study', 'plan-bound', '--seeds', '1', '--world', 'room', '--world', 'yard']
    assert main([*arguments, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found['tested'], found['good']) == (2, 2)
    assert (found['tested_with_people'], found['good_with_people']) == (1, 0)
    assert [(r['world'], r['people'], r['ratio']) for r in found['areas']] == [
        ('room', False, 1.0),
        ('room', True, 2.0),
        ('yard', False, 1.0),
    ]
    assert main(arguments) == 0
    assert 'with people: 0 of 1 areas' in capsys.readouterr().out


def test_no_place_is_unique_in_a_symmetric_layout():
    found = layout('symmetric', 40, 1, 0.1, 0.3)
    assert (found['planned_unique'], found['unique'], found['agree']) == (0, 0, 40)


def test_wrong_answer_is_counted(monkeypatch):
    right = layout('yard', 20, 1, 0.0, 0.0)
    assert (right['unique'], right['wrong']) == (20, 0)
    monkeypatch.setattr(study_plan_verdicts, 'is_right', lambda pose, truth: False)
    found = layout('yard', 20, 1, 0.0, 0.0)
    assert found['wrong'] == found['wrong_of_planned'] == 20


def test_new_worlds_can_be_planned():
    for name in WORLDS[4:6]:
        world = study_plan_bound.load_world(name)
        site = study_plan_bound.sites.of_world(world)
        seen = visible(site, world.route, Parameters(), study_plan_bound.SimulatorParameters())
        assert (seen.sum(axis=1) >= 3).all()
