# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench marginals``: the covariances are GTSAM's."""

from __future__ import annotations

import json

import pytest
from numpy.testing import assert_allclose

from rlml_lab.bench.bench_marginals import compare, without_residuals
from rlml_lab.bench.generated_graphs import city, warehouse
from rlml_lab.main import main
from rlml_slam.graph.g2o import write_graph


@pytest.mark.parametrize('make', [lambda: city(150), lambda: warehouse(150, 40)])
def test_measurements_are_replaced_by_what_the_optimum_predicts(make):
    source = make()
    graph = without_residuals(source)
    # angles are wrapped once more: rounding, against sigmas of 0.01 rad and more
    assert_allclose(graph.poses, source.poses, rtol=0, atol=1e-12)
    assert graph.chi2() < 1e-15 * len(graph.edges)
    assert len(graph.edges) == len(source.edges)
    assert len(graph.sightings) == len(source.sightings)


@pytest.mark.parametrize('make', [lambda: city(300), lambda: warehouse(200, 60)])
def test_covariances_of_poses_and_landmarks_are_those_of_gtsam(make):
    pytest.importorskip('gtsam')
    assert compare(make())['difference'] < 1e-6


def test_the_command_prints_one_json_object(tmp_path, capsys):
    pytest.importorskip('gtsam')
    path = tmp_path / 'city.g2o'
    write_graph(path, city(60))
    assert main(['bench', 'marginals', str(path), '--runs', '1', '--json']) == 0
    (result,) = json.loads(capsys.readouterr().out)['results']
    assert result['poses'] == 60
    assert result['difference'] < 1e-6


def test_a_peer_that_finds_the_equations_singular_is_told_as_such(tmp_path, capsys, monkeypatch):
    def fail(graph):
        raise RuntimeError('Indeterminate linear system')

    monkeypatch.setattr('rlml_lab.bench.bench_marginals._gtsam', fail)
    path = tmp_path / 'city.g2o'
    write_graph(path, city(60))
    assert main(['bench', 'marginals', str(path), '--runs', '1']) == 0
    assert 'gtsam finds the equations singular' in capsys.readouterr().out
    result = compare(city(60))
    assert result['rlml_ms'] > 0.0
    assert result['difference'] is None
