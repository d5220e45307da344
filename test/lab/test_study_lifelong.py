# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest

from rlml_lab.main import main
from rlml_lab.studies import study_lifelong as study
from rlml_slam.simulation.world_file import load_world


def test_loop_comes_back_and_has_thirty_reflectors():
    hall = load_world('hall')
    world = study.loop_of(hall, np.random.default_rng(0))
    np.testing.assert_array_equal(world.route[0], world.route[-1])
    assert len(world.reflectors) == 30
    assert len(set(world.reflectors.ids.tolist())) == 30
    moved = np.array([3, 8])
    points = study.moved_points(world, moved, np.random.default_rng(1))
    step = np.linalg.norm(points - world.reflectors.points, axis=-1)
    np.testing.assert_allclose(step[moved], study.FAR)
    assert step.sum() == pytest.approx(2 * study.FAR)


def test_short_drive_has_a_row_per_part(capsys):
    assert main(['study', 'lifelong', '--hours', '0.006', '--parts', '2', '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    first, last = figures['parts']
    assert first['hours'] == pytest.approx(0.003, abs=1e-3)
    assert last['hours'] == 0.006
    assert last['keyframes'] > first['keyframes'] > 0
    assert last['memory_mb'] > last['grown_mb']
    assert first['memory_mb'] - first['grown_mb'] == pytest.approx(
        last['memory_mb'] - last['grown_mb']
    )
    assert last['live_ate_rmse_m'] < 0.05
    assert figures['reflectors']['mapped'] > 0
    assert figures['reflectors']['unmoved_rmse_m'] < 0.05


def test_each_part_is_told_when_it_is_over(capsys):
    assert main(['study', 'lifelong', '--hours', '0.006', '--parts', '2']) == 0
    title, first, last, end = capsys.readouterr().out.splitlines()
    assert len(first) == len(last) == len(title)
    assert float(first.split()[0]) < float(last.split()[0])
    assert 'reflectors that stayed' in end


def test_no_time_is_refused(capsys):
    assert main(['study', 'lifelong', '--hours', '0']) == 1
    assert '--hours' in capsys.readouterr().err
