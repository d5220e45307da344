# SPDX-License-Identifier: Apache-2.0
"""Files, pictures and report of a run."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from made_runs import made_run
from numpy.testing import assert_allclose

from rlml_slam.datasets.tum import read_tum
from rlml_slam.errors import MapError
from rlml_slam.evaluation.metrics import metrics, run_errors
from rlml_slam.evaluation.run_record import Origin
from rlml_slam.maps import nav2_map, reflector_file
from rlml_slam.report.outputs import make_folder, write_outputs
from rlml_slam.report.pictures import ellipse
from rlml_slam.report.report import bad_spells, report_html
from rlml_slam.report.summary import summary_text
from rlml_slam.version import __version__

DATA = ('trajectory.tum', 'front_end.tum', 'health.csv', 'map.pgm', 'map.yaml', 'reflectors.csv')


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp('out') / 'deep' / 'run'
    run = made_run(name='a <run> & more')
    return folder, run, write_outputs(run, folder)


def test_all_files_are_there(written):
    folder, _, figures = written
    names = {f.name for f in folder.iterdir()}
    assert names == {*DATA, 'metrics.json', 'report.html'}
    assert json.loads((folder / 'metrics.json').read_text()) == figures


def test_files_hold_the_run(written):
    folder, run, _ = written
    optimized, live = read_tum(folder / 'trajectory.tum'), read_tum(folder / 'front_end.tum')
    # nine decimals are written
    assert_allclose(optimized.poses[:, :2], run.trajectory.poses[:, :2], atol=1e-9)
    assert_allclose(live.poses[3, :2], run.frames.poses[3][:2], atol=1e-9)
    assert_allclose(
        reflector_file.load(folder / 'reflectors.csv').points, run.reflectors.points, atol=1e-6
    )
    grid = nav2_map.load(folder / 'map.yaml')
    assert np.array_equal(grid.cells, run.grid.cells)


def test_report_needs_nothing_else_and_is_small(written):
    folder, _, _ = written
    html = (folder / 'report.html').read_text()
    tags = re.sub(r'<script.*?</script>', '', html, flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?!data:)', tags)
    assert 'http' not in tags
    assert not re.findall(r'<script[^>]*src=', html)
    assert len(html) < 4_000_000


def test_footer_says_what_the_run_was_made_by():
    run = made_run()
    run.origin = Origin('rlml replay a <bag>', {'use_odom': False}, 'bag, SHA-256 12ab')
    html = report_html(run, metrics(run), run_errors(run))
    footer = html[html.index('<footer>') :]
    for part in (__version__, 'rlml replay a &lt;bag&gt;', 'use_odom=False', 'SHA-256 12ab'):
        assert part in footer
    about = {'version': __version__, 'system': 'rlml', 'parameters': {'use_odom': False}}
    assert metrics(run)['about'] == about  # what two runs are compared by


def test_report_escapes_names_and_tells_what_was_wrong(written):
    folder, _, _ = written
    html = (folder / 'report.html').read_text()
    assert 'a &lt;run&gt; &amp; more' in html
    assert 'DEGRADED: saw 0 of 4' in html
    assert 'NEES' in html


def test_same_run_gives_the_same_bytes(written, tmp_path):
    folder, run, _ = written
    write_outputs(run, tmp_path)
    for name in DATA:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_run_without_scans_truth_and_timing_has_a_report(tmp_path):
    run = made_run()
    run.grid = run.truth = None
    run.frames.wall_ms, run.back_end_ms = [], np.zeros(0)
    run.problem = 'bag: damaged after 3 messages'
    write_outputs(run, tmp_path)
    # a map without knowledge, around the path
    grid = nav2_map.load(tmp_path / 'map.yaml')
    assert (grid.cells == -1).all()
    assert 'damaged after 3 messages' in (tmp_path / 'report.html').read_text()


def test_files_of_an_earlier_run_are_set_aside(tmp_path):
    others = ('map.rlml', 'closures.csv', 'report.html')
    for name in others:
        (tmp_path / name).write_text('of another run')
    run = made_run()
    run.stored, run.closure_table = None, ''
    for known in (tmp_path / 'map.rlml', tmp_path, tmp_path / 'map.yaml'):
        write_outputs(run, tmp_path, report=False, known=known)
        assert (tmp_path / 'map.rlml').exists()  # the run localized in it
        assert not (tmp_path / 'map.pgm').exists()  # nor is its image or its table another one
        assert not (tmp_path / 'reflectors.csv').exists()
    write_outputs(run, tmp_path, report=False)
    for name in others:
        assert not (tmp_path / name).exists()
        assert (tmp_path / f'{name}.previous').read_text() == 'of another run'


def test_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(MapError, match='file: cannot be made'):
        make_folder(tmp_path / 'file')


def test_results_do_not_go_into_a_bag(tmp_path):
    (tmp_path / 'metadata.yaml').write_text('')
    with pytest.raises(MapError, match='is a bag: name another folder'):
        make_folder(tmp_path)


def test_spells_are_the_ones_that_were_not_ok():
    run = made_run()
    assert list(bad_spells(run)) == [('20.0 to 29.0 s', 'DEGRADED: saw 0 of 4')]
    run.frames.reasons[25] = ('something else',)
    assert [when for when, _ in bad_spells(run)] == [
        '20.0 to 24.0 s', '25.0 to 25.0 s', '26.0 to 29.0 s',
    ]  # fmt: skip
    assert list(bad_spells(run, most=1))[-1] == ('…', 'and more')


def test_summary_names_what_a_person_asks_first(written):
    _, run, figures = written
    text = summary_text(run.name, figures)
    for part in ('29.5 × real time', '0.030 m RMSE', '1 accepted, 2 rejected', '60 used'):
        assert part in text


def test_ellipse_holds_95_percent():
    # axes 2 sqrt(5.991) sigma, the long one along 30 degrees
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    R = np.array([[c, -s], [s, c]])
    e = ellipse(np.array([1.0, 2.0]), R @ np.diag([0.04, 0.01]) @ R.T)
    assert (e.width, e.height) == (pytest.approx(0.979, abs=1e-3), pytest.approx(0.4895, abs=1e-3))
    assert e.angle % 180.0 == pytest.approx(30.0)
