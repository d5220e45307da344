# SPDX-License-Identifier: Apache-2.0
"""A small site: its sessions become one map, and those of another site are left out."""

import json

import numpy as np

from rlml_lab.main import main
from rlml_lab.site.large_site import AISLE, alignment_errors, make_route, make_site
from rlml_slam import se2


def test_sessions_of_a_site_become_one_map(tmp_path, capsys):
    args = ['--sessions', '7', '--length', '70', '--scans', '2', '--out', str(tmp_path), '--json']
    mine = np.ones(100_000_000)  # 800 MB, which are none of the process that merges
    assert main(['study', 'site', *args]) == 0
    del mine
    (figures,) = json.loads(capsys.readouterr().out)
    assert figures['wrong'] == 0
    assert figures['spurious'] == 0
    assert figures['strangers_left_out'] == 2
    assert figures['placed'] >= 3
    assert figures['found'] >= 40
    assert figures['rms_mm'] < 20.0
    assert 50.0 < figures['merge_mb'] < 800.0
    assert set(figures['left_out']) >= {'session-05', 'session-06'}


def test_routes_stay_in_the_aisles_of_the_site():
    rng = np.random.default_rng(0)
    route = make_route(60.0, np.array([0.0, 30.0]), 300.0, rng)
    steps = np.diff(route, axis=0)
    assert np.allclose(np.abs(steps).sum(axis=1), AISLE)
    assert (steps[1:] + steps[:-1]).any(axis=1).all()  # never straight back
    assert ((route >= 0.0) & (route <= 60.0)).all()
    site = make_site(60.0, 36, rng)
    assert len(site.reflectors) == 36
    gap = np.linalg.norm(site.reflectors[:, None] - site.reflectors, axis=-1)
    assert gap[gap > 0.0].min() > 1.5


def test_errors_are_those_after_the_best_alignment():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.0, 100.0, (30, 2))
    found = se2.transform(np.array([0.2, -0.1, 0.002]), truth[:20])
    error, rows = alignment_errors(found, truth)
    assert error.max() < 1e-9
    assert rows.tolist() == list(range(20))
