# SPDX-License-Identifier: Apache-2.0
"""rlml-lab bench back-end: what it refuses, and a run without rivals."""

from __future__ import annotations

import importlib.util
import json

import numpy as np

from rlml_lab import main

GRAPH = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 0
VERTEX_SE2 2 2 0.1 0
EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1
EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1
"""


def test_g2o_with_a_numpy_that_kills_it_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: name == 'g2o')
    monkeypatch.setattr(np, '__version__', '2.4.6')
    path = tmp_path / 'a.g2o'
    path.write_text(GRAPH)
    assert main.main(['bench', 'back-end', str(path)]) == 1
    assert "'numpy<2', or --without g2o" in capsys.readouterr().err


def test_alone_it_reaches_the_optimum_from_both_starts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, 'find_spec', lambda _: None)
    path = tmp_path / 'a.g2o'
    path.write_text(GRAPH)
    assert main.main(['bench', 'back-end', str(path), '--runs', '1', '--json']) == 0
    results = json.loads(capsys.readouterr().out)['results']
    assert [r['start'] for r in results] == ['file', 'odometry']
    for r in results:
        assert r['solvers']['rlml']['chi2'] < 1e-9
        assert r['ratio'] is None
