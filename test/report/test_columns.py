# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows of a run."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from made_runs import made_run
from numpy.testing import assert_allclose
from PIL import Image

from rlml_slam.evaluation.metrics import run_errors
from rlml_slam.report.viewer import columns
from rlml_slam.report.viewer.columns import MAX_SIDE, SOURCES, as_lists, columns_of


@pytest.fixture(scope='module')
def shown():
    run = made_run()
    return columns_of(run, run_errors(run))


def test_every_source_has_its_columns_of_one_length(shown):
    assert shown.keys() == SOURCES.keys()
    for name, of in shown.items():
        assert set(of) == set(SOURCES[name]), name
        assert len({len(values) for values in of.values()}) == 1, name


def test_errors_and_sigmas_are_those_of_the_run(shown):
    f = shown['frames']
    assert_allclose(f['error'], 3.0, rtol=1e-5)  # cm
    assert_allclose(f['sigma'], 3.0, rtol=1e-5)
    assert_allclose(f['bound'], 9.0, rtol=1e-5)
    assert_allclose(shown['path_error']['error'], 0.0, atol=1e-5)
    assert_allclose(f['t'], np.arange(60.0))


def test_spells_of_health_cover_the_run(shown):
    h = shown['health']
    assert h['name'] == ['OK', 'DEGRADED', 'OK']
    assert h['left'] == pytest.approx([0.0, 20.0, 30.0])
    assert h['right'] == pytest.approx([20.0, 30.0, 59.0])
    assert h['reason'][1] == 'saw 0 of 4'


def test_ellipse_of_a_reflector_holds_95_percent():
    run = made_run()
    c, s = np.cos(0.5), np.sin(0.5)
    R = np.array([[c, -s], [s, c]])
    run.reflectors.cov[:] = R @ np.diag([0.04, 0.01]) @ R.T
    of = columns.reflectors(run.reflectors)
    assert_allclose(of['width'], 2 * np.sqrt(5.991) * 0.2)
    assert_allclose(of['height'], 2 * np.sqrt(5.991) * 0.1)
    assert_allclose(of['angle'] % np.pi, 0.5)
    assert_allclose(of['sigma'], 20.0)


def test_aligned_truth_is_shown_over_the_path():
    run = made_run(is_map=False)
    run.truth.trajectory.poses[:, :2] += 100.0
    of = columns_of(run, run_errors(run))
    assert_allclose(of['truth']['x'], of['path']['x'], atol=1e-4)


def test_grid_is_a_picture_in_its_place():
    run = made_run()
    of = columns.grid(run.grid)
    assert of['width'] == of['height'] == [10.0]
    assert of['x'] == [0.0]
    assert of['y'] == [3.0]
    for url in (of['light'][0], of['dark'][0]):
        image = Image.open(io.BytesIO(base64.b64decode(url.partition(',')[2]))).convert('RGBA')
        assert image.size == (200, 200)
        assert image.getpixel((100, 100))[3] == 0  # free: paper
        assert image.getpixel((100, 20))[3] == 255  # a wall; rows run from the top
        assert 0 < image.getpixel((0, 0))[3] < 60  # unknown


def test_walls_stay_in_a_large_grid():
    cells = np.zeros((10, 5 * MAX_SIDE), dtype=np.int8)
    cells[3, 7] = 100
    url = columns.grid_pictures(cells)[0]
    image = Image.open(io.BytesIO(base64.b64decode(url.partition(',')[2]))).convert('RGBA')
    assert image.size[0] == MAX_SIDE
    assert np.asarray(image)[:, :, 3].max() == 255


def test_scans_are_distinguished_by_their_counts():
    run = made_run()
    for k in range(3):
        run.frames.scans.add(run.frames.stamps[k], np.full((k + 1, 2), float(k)))
    of = columns_of(run, None)
    assert of['scans']['count'].tolist() == [1, 2, 3]
    assert of['points']['x'].tolist() == [0, 100, 100, 200, 200, 200]


def test_run_without_anything_has_every_source():
    run = made_run()
    run.grid = run.truth = None
    run.frames.wall_ms, run.frames.seen = [], []
    of = columns_of(run, None)
    assert np.isnan(of['frames']['ms']).all()
    assert np.isnan(of['frames']['seen']).all()
    assert not len(of['truth']['x'])


def test_json_has_no_nan(shown):
    of = as_lists({'a': np.array([1.0, np.nan, 2.123456]), 'b': ['x', 'y', 'z']})
    assert of == {'a': [1.0, None, 2.1235], 'b': ['x', 'y', 'z']}
